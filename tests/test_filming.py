"""Films of paths, and pictures of equilibria in notebooks."""

import jax
import numpy as np
import pytest

import rodjax as rj
from rodjax import filming

LEVEL = rj.frame((1.0, 0.0, 0.0))


def scene(x: float) -> rj.Scene:
    return rj.Scene(rj.problems.cable(), rj.Clamp((0, 0, 0), LEVEL), rj.Clamp((x, 0, 0), LEVEL), (0, 0, -9.81))


@pytest.fixture(scope="module")
def path() -> rj.Equilibrium:
    found = [rj.solve(scene(x), segments=4) for x in (0.8, 0.75)]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *found)


def test_a_path_becomes_a_gif_of_as_many_pictures(path, tmp_path):
    image = pytest.importorskip("PIL.Image", reason="matplotlib brings pillow")
    rj.film(path, tmp_path / "path.gif", fps=5)
    with image.open(tmp_path / "path.gif") as film:
        assert (film.n_frames, film.size, film.info["duration"]) == (2, (960, 640), 200)
        first = np.asarray(film.convert("RGB"), int)
        film.seek(1)
        changed = np.abs(np.asarray(film.convert("RGB"), int) - first).max(axis=-1) > 60
    assert 0.002 < np.mean(changed) < 0.2  # the rod has moved, the axes have not


def test_pictures_become_a_film_in_mp4():
    pytest.importorskip("av", reason="what writes .mp4: pip install 'rodjax[film]'")
    imageio = pytest.importorskip("imageio.v3")
    pictures = [np.full((65, 97, 3), level, np.uint8) for level in (0, 120, 240)]
    content = filming.film_content(pictures, "film.mp4", 5)
    read = imageio.imread(content, extension=".mp4", plugin="pyav")
    assert read.shape == (3, 64, 96, 3)  # even, as H.264 wants them
    np.testing.assert_allclose(read.mean(axis=(1, 2, 3)), (0, 120, 240), atol=5)  # lossy


def test_arguments_that_make_no_sense_are_refused(path, tmp_path, monkeypatch):
    one = jax.tree.map(lambda leaf: leaf[0], path)
    with pytest.raises(ValueError, match="path must have one leading axis, got \\(\\)"):
        rj.film(one, tmp_path / "path.gif")
    with pytest.raises(ValueError, match=r"file must end in \.gif or \.mp4"):
        rj.film(path, tmp_path / "path.avi")
    with pytest.raises(ValueError, match="color_by must be"):
        rj.film(path, tmp_path / "path.gif", color_by="colour")  # pyright: ignore[reportArgumentType]
    monkeypatch.setattr(filming, "best_suffix", lambda: ".gif")
    with pytest.raises(ImportError, match=r"pip install 'rodjax\[film\]', or take .gif"):
        rj.film(path, tmp_path / "path.mp4")
    assert list(tmp_path.iterdir()) == []


def test_a_notebook_shows_numbers_and_a_picture_of_a_single_rod(path):
    one = jax.tree.map(lambda leaf: leaf[0], path)
    shown = one._repr_html_()
    assert shown.startswith("<table>")
    assert '<img alt="the rod, coloured by curvature" src="data:image/png;base64,iVBOR' in shown
    assert "<img" not in path._repr_html_()
