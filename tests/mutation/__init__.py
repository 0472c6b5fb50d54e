"""A mutation run: break the algorithms on purpose, one line at a time, and see whether the tests notice.

breaks.py           the table of breaks
run.py              copies, runs, and what they tell
__main__.py         the command line: ``python -m tests.mutation``
test_mutation.py    that the table fits the source (fast), and the whole run (slow)
"""
