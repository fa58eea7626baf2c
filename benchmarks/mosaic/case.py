"""One case in a process of its own: `python -m benchmarks.mosaic.case '{"task": …, "solver": …, "case": {…}}'`.

The last line of the output is a JSON object with one key: "result"; "cannot", what the solver says it cannot do;
"unavailable", what is not installed; or "failed", the error of the run."""

import importlib
import json
import sys

from benchmarks.__main__ import use_one_thread


def answer(task, name, case):
    from benchmarks.mosaic import solvers

    module = importlib.import_module(f"benchmarks.mosaic.tasks.{task}")
    try:
        solver = solvers.load(solvers.FLOWS if module.FAMILY == "flow" else solvers.CONDUCTION, name)
    except ImportError as error:
        return {"unavailable": str(error)}
    reason = solver.CANNOT.get(getattr(module, "ABILITY", None))
    if reason:
        return {"cannot": reason}
    try:
        return {"result": module.run(solver, case)}
    except Exception as error:
        first = (str(error).strip().splitlines() or [""])[0]
        return {"failed": f"{type(error).__name__}: {first}"[:200]}


def main():
    use_one_thread()
    import torch  # only now: it reads the environment

    torch.set_num_threads(1)
    asked = json.loads(sys.argv[1])
    found = answer(asked["task"], asked["solver"], asked["case"])
    print(json.dumps(found))


if __name__ == "__main__":
    main()
