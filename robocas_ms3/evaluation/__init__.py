"""Evaluation of policies: frozen protocols, sessions that run their episodes, results, statistics and reports.

`session` runs episodes, `results` reads and writes their outcomes, `report` shows them. `policies` are chosen by name;
`remote` connects to a policy behind a socket, `harness` to the evaluation loops of other packages.
"""
