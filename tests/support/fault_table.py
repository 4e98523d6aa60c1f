"""Print the fault table from the rows of `tests/faults`: `python fault_table.py ROWS [OUT.json]`."""

import json
import sys
from pathlib import Path

HEAD = ("fault", "command", "times injected", "episodes lost", "duplicates", "seconds to continue", "")


def cells(row):
    seconds = row["seconds"]
    delay = f"{min(seconds):g}" if seconds else "-"
    if seconds and max(seconds) > min(seconds):
        delay += f" to {max(seconds):g}"
    return (row["fault"], row["command"], row["injected"], row["lost"], row["duplicates"], delay, row["note"])


def table(rows):
    lines = [HEAD, tuple("---" for _ in HEAD), *map(cells, rows)]
    return "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines)


if __name__ == "__main__":
    rows = [json.loads(line) for line in Path(sys.argv[1]).read_text().splitlines()]
    print(table(rows))
    if len(sys.argv) > 2:
        Path(sys.argv[2]).write_text(json.dumps(rows, indent=1) + "\n")
