"""The pictures of the documentation: the report of the first tutorial, as a picture and along the hose.

python experiments/site_pictures.py [--out docs]
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import jax

import rodjax
from rodjax.routing.files import read_route_file

HOSE = Path(__file__).parent / "routes" / "hose.toml"
DPI = 90


def main(arguments: Sequence[str] | None = None) -> list[Path]:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder for the pictures")
    folder = parser.parse_args(arguments).out
    jax.config.update("jax_enable_x64", True)
    file = read_route_file(HOSE, with_scene=True)
    cables = {name: rodjax.solve(scene.scenes[0], **scene.settings) for name, scene in file.cables.items()}
    report = rodjax.report(cables, limits=file.limits, obstacles=file.obstacles, names=file.names, title=file.title)
    written = [folder / "hose.png", folder / "hose_along.png"]
    for figure, path in zip((report.figure(), report.along()), written, strict=True):
        figure.savefig(path, dpi=DPI)
    return written


if __name__ == "__main__":
    main()
