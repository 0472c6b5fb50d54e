"""``otsync plugins``: what there is in each slot, and who brought it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ..plugins import GROUPS, entries, registered
from .tables import print_json


@dataclass
class Plugins:
    """List what other packages and files add to otsync: matchers, aligners, readers, losses, commands, ...

    Example: otsync plugins

    With a file of your own: otsync --plugin my_matcher.py plugins
    """

    json: bool = False
    """Print the list as JSON."""

    def run(self) -> int:
        rows: list[dict[str, Any]] = []
        for group in GROUPS:
            for name, point in entries(group).items():
                brought = point.dist.name if point.dist is not None else "an installed package"
                rows.append({"group": group, "name": name, "from": f"{brought}: {point.value}"})
            for name, thing in registered(group).items():
                rows.append({"group": group, "name": name, "from": f"file: {getattr(thing, '__module__', '?')}"})
        if self.json:
            print_json({"plugins": rows})
            return 0
        for group, about in GROUPS.items():
            print(f"{group} ({about}; entry points in otsync.{group})")
            for row in rows:
                if row["group"] == group:
                    print(f"    {row['name']}  from {row['from']}")
        return 0
