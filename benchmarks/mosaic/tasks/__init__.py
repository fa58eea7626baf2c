"""The tasks, one file each.

A task is a module with

- `TITLE` and `FAMILY`, the solvers that it is for ("flow" or "conduction")
- `cases(quick)`: what is run, a list of plain dictionaries
- `run(solver, case)`: what one solver (its class) reaches, a dictionary of numbers
- `ABILITY`, if it needs one: solvers that name it in their `CANNOT` are listed with that reason
"""

NAMES = ("forward", "cost", "gradient", "horizon", "design", "recovery", "conduction")
