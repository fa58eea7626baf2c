"""`python -m benchmarks.pictures [NAME ...]`: draw the pictures of docs/ again, from the records that lie beside them.
A picture that would look the same is left as it is.

Not drawn again are the curves of `prdp compare` (docs/results/*_metric.png) and the snapshots of the inference study:
their records would be too large for the repository."""

import argparse
import importlib
import io
import json
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image

from benchmarks import overview_charts, page, refinement_charts
from benchmarks.atlas import MAPS
from benchmarks.mosaic import charts as mosaic_charts
from prdp_torch.experiments import charts, scenes

DOCS = Path(__file__).parents[1] / "docs"


def read(path):
    return json.loads(path.read_text())


def all_of_them():
    """(path, dpi, function that draws it) of each picture."""
    results, stability = DOCS / "results", DOCS / "stability"
    yield results / "heat_1d_errors.png", 110, lambda: overview_charts.errors(read(results / "heat_1d.json"))
    yield results / "refinement.png", 110, lambda: overview_charts.products(refinement_charts.summaries())
    for path in sorted(results.glob("*_accuracy.png")):
        yield path, 120, partial(accuracy, path.with_name(path.name.replace("_accuracy.png", ".json")))
    for name, figure in refinement_charts.figures():
        yield results / name, 110, partial(as_it_is, figure)
    for path in sorted((results / "studies").glob("*.json")):
        yield path.with_suffix(".png"), 110, partial(study, path)
    for name in MAPS:
        yield stability / f"{name}.png", 110, partial(atlas, name, stability / f"{name}.json")
    for part in page.sections(performance()):
        yield DOCS / "performance" / f"{part['name']}.png", 130, partial(as_it_is, part["figure"])
    for task in ("cost", "design", "recovery", "conduction"):
        for name, figure in mosaic_charts.of(task, read(DOCS / "flows" / f"{task}.json")["rows"]).items():
            yield DOCS / "flows" / f"{name}.png", 110, partial(as_it_is, figure)


def is_drawn(path, dpi, figure):
    """Whether the file shows the figure, but for a thousandth of its pixels."""
    if not path.exists():
        return False
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=dpi)
    new, old = (np.asarray(Image.open(image).convert("RGB"), dtype=int) for image in (drawn, path))
    return new.shape == old.shape and (np.abs(new - old).max(-1) > 8).mean() < 1e-3


def as_it_is(figure):
    return figure


def accuracy(path):
    """The accuracy chart of a comparison."""
    record = read(path)
    return charts.accuracy_against_cost(scenes.load(record["settings"]["scene"]), record["rows"])


def study(path):
    return importlib.import_module(f"benchmarks.studies.{path.stem}").chart(read(path)["rows"])


def atlas(name, path):
    return MAPS[name].draw(read(path)["data"])


def performance():
    """What each suite found."""
    found = {path.stem: read(path) for path in sorted((DOCS / "performance").glob("*.json"))}
    return {suite: record[suite] for suite, record in found.items() if suite in record}


def main():
    parser = argparse.ArgumentParser(prog="python -m benchmarks.pictures", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="such as refinement; all pictures by default")
    options = parser.parse_args()
    known = {path.stem: (path, dpi, draw) for path, dpi, draw in all_of_them()}
    if unknown := set(options.names) - set(known):
        parser.error(f"unknown: {', '.join(sorted(unknown))}; allowed: {', '.join(known)}")
    for name in options.names or known:
        path, dpi, draw = known[name]
        figure = draw()
        if not is_drawn(path, dpi, figure):
            charts.write_png(figure, path, dpi=dpi)
            print(path.relative_to(DOCS.parent))


if __name__ == "__main__":
    main()
