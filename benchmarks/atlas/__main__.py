"""Maps of where the methods work and where they break, a picture and a record for each question:
`python -m benchmarks.atlas contrast`.
"""

import argparse
from pathlib import Path

from benchmarks import atlas
from prdp_torch.experiments import records


def main():
    parser = argparse.ArgumentParser(prog="python -m benchmarks.atlas", description=__doc__)
    parser.add_argument("maps", nargs="*", metavar="MAP", help=f"{', '.join(atlas.MAPS)}; all.")
    parser.add_argument("--out", type=Path, default=Path("runs/stability"), help="folder for the results")
    parser.add_argument("--quick", action="store_true", help="a few points of each map, to see that all of it runs")
    options = parser.parse_args()

    def show(name, answer, seconds):
        print(f"{name}: {atlas.MAPS[name].question} {answer} ({seconds:.0f} s)", flush=True)

    try:
        atlas.run(records.prepare_folder(options.out), options.maps, options.quick, show)
    except ValueError as error:
        parser.error(str(error))
    print(f"pictures and records: {options.out}")


if __name__ == "__main__":
    main()
