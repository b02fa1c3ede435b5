"""``examples/minigrid_options.py`` as a user runs it, but shorter, and the film of its agent."""

from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest
from sb3_contrib import MaskablePPO

from experiments.minigrid import film
from sb3_options import OptionBank
from tests.support import processes
from tests.support.documents import ROOT, SHORTER

EXAMPLE = ROOT / "examples" / "minigrid_options.py"


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("example")
    shorter = folder / EXAMPLE.name
    shorter.write_text(SHORTER.sub(r"\g<1>\g<3>\g<2>", EXAMPLE.read_text(encoding="utf-8")), encoding="utf-8")
    result = processes.python(str(shorter), cwd=folder)
    assert result.returncode == 0, result.stderr
    return folder / "minigrid.zip"


def test_the_example_leaves_a_model_that_went_on_in_four_rooms(model: Path) -> None:
    loaded = MaskablePPO.load(model, device="cpu")
    assert loaded.action_space.n == 7 + 4  # type: ignore[attr-defined]  # it is Discrete
    assert loaded.n_envs == 16
    OptionBank(7, 4).load(model.with_name("options.safetensors"))
    assert sum(bool(line) for line in EXAMPLE.read_text(encoding="utf-8").splitlines()) <= 20


def test_the_film_names_what_runs(tmp_path: Path) -> None:
    film.main(film.Study(out=tmp_path / "film.gif", frames=(2_048, 2_048), episodes=1))
    pictures = imageio.mimread(tmp_path / "film.gif")
    assert len(pictures) >= 2
    left, right = np.split(pictures[0][:, : pictures[0].shape[1] // 2 * 2], 2, axis=1)
    assert left[-20:].min() < 128 < left[-20:].mean()  # the name of what runs, on white
    assert right.std() > 0
