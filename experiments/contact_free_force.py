"""What must be measured to know stiffness and weight of a cable apart?

    python experiments/contact_free_force.py [--out docs]

A shape under gravity tells EI over weight per length alone: the same cable twice as stiff and twice as heavy hangs the
same. Nothing need touch the cable to find both: a load cell under one clamp is enough. Synthetic measurements of a
cable at three spans, points to 1 mm, forces to 10 mN, fitted with what is named in each row; last what to measure next.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from measuring import save_rows, set_up

import rodjax as rj

EI, MASS = 4.9e-3, 0.08
SPANS = (0.6, 0.75, 0.9)
S = np.linspace(0.05, 0.95, 19)
SD_POINT, SD_FORCE = 1e-3, 1e-2
SETTINGS: dict[str, Any] = dict(segments=16, planar=True)
LEVEL, UP = (1, 0, 0), (0, 0, 1)


class Row(NamedTuple):
    """Relative standard errors of EI and of the weight; the estimates by the truth."""

    measured: str
    stiffness_error: str
    weight_error: str
    stiffness_by_truth: str
    weight_by_truth: str


def scene(span: float, EI: float = EI, mass: float = MASS) -> rj.Scene:
    level = rj.frame(LEVEL)
    rod = rj.Rod(1.0, EI, 2 / 3 * EI, 1e4, mass)
    return rj.Scene(rod, rj.Clamp((0, 0, 0), level), rj.Clamp((span, 0, 0), level), (0, 0, -9.81))


def experiments(what: Sequence[str]) -> list[rj.Experiment]:
    """With the measurements of these names, of the same cable every time."""
    draw = np.random.default_rng(4)
    found = []
    for span in SPANS:
        shape = rj.solve(scene(span), segments=32)
        points = np.asarray(shape.position_at(S)) + SD_POINT * draw.standard_normal((len(S), 3))
        force = np.asarray(shape.end_force) + SD_FORCE * draw.standard_normal(3)
        every = {
            "shape": rj.Centerline(points, S, SD_POINT),
            "level force": rj.EndForce(force[0], SD_FORCE, direction=LEVEL),
            "vertical force": rj.EndForce(force[2], SD_FORCE, direction=UP),
        }
        start = scene(span, 1.5 * EI, 0.7 * MASS)
        found.append(rj.Experiment(start, [every[name] for name in what], name=f"span {span} m"))
    return found


def fitted(what: Sequence[str]) -> tuple[Row, rj.Fit | None]:
    name = " and ".join(what)
    try:
        fit = rj.fit(experiments(what), ["rod.EI", "rod.mass_per_length"], **SETTINGS)
    except rj.NotIdentifiableError as error:
        return Row(name, "none", "none", f"refused: {error.fit.undetermined[0].words}", ""), None
    EI_found, mass_found = fit.estimate["rod.EI"], fit.estimate["rod.mass_per_length"]
    errors = fit.standard_error["rod.EI"] / EI_found, fit.standard_error["rod.mass_per_length"] / mass_found
    return Row(name, *(f"{x:.4f}" for x in errors), *(f"{x:.4f}" for x in (EI_found / EI, mass_found / MASS))), fit


def main(argv: Sequence[str] | None = None) -> list[Row]:
    parser = argparse.ArgumentParser(description="What tells stiffness and weight of a cable apart.")
    parser.add_argument("--out", type=Path, default=Path("docs"))
    parser.add_argument("--few", action="store_true", help="the shape alone and with the vertical force only")
    arguments = parser.parse_args(argv)
    cases = [("shape",), ("shape", "vertical force")]
    if not arguments.few:
        cases += [("shape", "level force"), ("level force", "vertical force")]
    rows = []
    both = None
    for what in cases:
        row, fit = fitted(what)
        rows.append(row)
        both = fit if what == ("shape", "vertical force") else both
    for row in rows:
        print(f"{row[0]:32} EI +- {row[1]:8} weight +- {row[2]:8} by the truth: {row[3]} {row[4]}")
    save_rows(rows, arguments.out / "contact_free_force.csv")
    assert both is not None
    candidates = [
        rj.Experiment(
            scene(span), (rj.Centerline(np.zeros((len(S), 3)), S, SD_POINT), rj.EndForce(0.0, SD_FORCE, direction=UP))
        )
        for span in (0.3, 0.5, 0.7, 0.85, 0.95)
    ]
    ranking = both.next_experiment(candidates)
    print("measured next, shape and vertical force, best first:")
    for k in ranking.order:
        end = candidates[k].scene.end
        assert isinstance(end, rj.Clamp)
        errors = ranking.standard_errors["rod.EI"][k] / EI, ranking.standard_errors["rod.mass_per_length"][k] / MASS
        print(f"  span {float(end.position[0]):.2f} m: EI +- {errors[0]:.4f}, weight +- {errors[1]:.4f}")
    return rows


if __name__ == "__main__":
    set_up()
    main()
