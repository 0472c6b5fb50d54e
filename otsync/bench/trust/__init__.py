"""Whether "ok" is right: worlds that hold and worlds that mislead, what is claimed of them and what is found.

worlds.py   the classes, each a function of a seed
run.py      answers, errors and claims; tables; the diagram
diagram.py  claimed against found
thresholds.py  what other values of the limits behind the flags would trust
"""
