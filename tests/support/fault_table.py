"""Print the table of faults, of the lines that `tests/faults` noted: `python fault_table.py ROWS [OUT.json]`."""

import json
import sys
from pathlib import Path

HEAD = ("fault", "command", "times injected", "episodes lost", "doubled", "seconds to go on", "")


def cells(row):
    seconds = row["seconds"]
    spent = f"{min(seconds):g}" if seconds else "-"
    if seconds and max(seconds) > min(seconds):
        spent += f" to {max(seconds):g}"
    return (row["fault"], row["command"], row["injected"], row["lost"], row["doubled"], spent, row["note"])


def table(rows):
    lines = [HEAD, tuple("---" for _ in HEAD), *map(cells, rows)]
    return "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines)


if __name__ == "__main__":
    rows = [json.loads(line) for line in Path(sys.argv[1]).read_text().splitlines()]
    print(table(rows))
    if len(sys.argv) > 2:
        Path(sys.argv[2]).write_text(json.dumps(rows, indent=1) + "\n")
