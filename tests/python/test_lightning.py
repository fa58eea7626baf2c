"""The example for PyTorch Lightning, where that is installed: `requirements.txt` has it."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

EXAMPLES = Path(__file__).parents[2] / "examples"

# Lightning warns of itself when it is imported, so it has a process of its own.
PROGRAM = """
import json, torch
from lightning_training import fit
whole = fit(16, "whole")
first = fit(6, "parts")
rest = fit(16, "parts", resume_from="parts/epoch_6.ckpt")
print(json.dumps([
    [record.max_iter for record in whole.controller.history],
    whole.controller.history == rest.controller.history,
    whole.heat.max_iter, rest.heat.max_iter,
    all(torch.equal(a, b) for a, b in zip(whole.parameters(), rest.parameters())),
]))
"""

if importlib.util.find_spec("lightning"):

    def test_the_controller_goes_on_from_the_checkpoint_of_lightning(tmp_path):
        done = subprocess.run(
            [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(EXAMPLES)!r}){PROGRAM}"],
            cwd=tmp_path,
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr
        budgets, same_history, k_whole, k_rest, same_weights = json.loads(done.stdout.splitlines()[-1])
        assert len(budgets) == 16 and budgets[0] == 1 and budgets == sorted(budgets)
        assert k_whole == k_rest > 1 and same_history and same_weights
