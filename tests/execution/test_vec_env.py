from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecFrameStack, VecNormalize, VecTransposeImage

from sb3_options.execution.vec_env import as_wrapper_sees
from tests.support.sb3_helpers import Corridor


def assert_seen(back: Any, inner: DummyVecEnv) -> None:
    for i, corridor in enumerate(e for e in inner.envs if isinstance(e, Corridor)):
        single = corridor.see(corridor.place)
        for key, value in single.items() if isinstance(single, dict) else [("", single)]:
            np.testing.assert_array_equal((back[key] if key else back)[i], value)


@pytest.mark.parametrize("kind", ["box", "discrete", "image", "dict", "dict_discrete"])
def test_gives_back_what_the_environments_saw(kind: str) -> None:
    inner = DummyVecEnv([lambda: Corridor(kind), lambda: Corridor(kind)])
    venv: VecEnv = VecTransposeImage(inner) if kind in ("image", "dict") else inner
    venv.seed(0)
    seen = venv.reset()
    back = as_wrapper_sees(venv, seen)
    assert_seen(back, inner)
    if kind == "image":
        assert isinstance(seen, np.ndarray)
        assert (seen.shape, back.shape) == ((2, 3, 36, 40), (2, 36, 40, 3))


STACKED: dict[str, Callable[[VecEnv], VecEnv]] = {
    "stack": lambda venv: VecFrameStack(venv, 3),
    "first": lambda venv: VecFrameStack(venv, 3, channels_order="first"),
    "transposed": lambda venv: VecTransposeImage(VecFrameStack(venv, 3)),
    "stack of transposed": lambda venv: VecFrameStack(VecTransposeImage(venv), 3),
    "skipped": lambda venv: VecFrameStack(VecTransposeImage(venv, skip=True), 3),
}


@pytest.mark.parametrize(
    ("kind", "how"),
    [("box", "stack"), ("box", "first")] + [(kind, how) for kind in ("image", "dict") for how in STACKED],
)
def test_the_newest_of_stacked_frames_is_what_the_environments_saw(kind: str, how: str) -> None:
    inner = DummyVecEnv([lambda: Corridor(kind), lambda: Corridor(kind)])
    venv = STACKED[how](inner)
    venv.seed(0)
    seen: Any = venv.reset()
    rng, places = np.random.default_rng(0), set[int]()
    for _ in range(60):
        assert_seen(as_wrapper_sees(venv, seen), inner)
        places |= set(inner.get_attr("place"))
        seen, _, _, _ = venv.step(rng.integers(2, size=2))
    assert len(places) > 5


@pytest.mark.parametrize("normalized", [True, False])
def test_what_was_normalised_is_undone_where_it_is_said_so(normalized: bool) -> None:
    venv = VecNormalize(DummyVecEnv([lambda: Corridor("box")] * 2), clip_obs=1e6)
    venv.seed(0)
    venv.reset()
    for _ in range(5):
        seen = venv.step(np.ones(2))[0]
    expected = venv.get_original_obs() if normalized else seen
    np.testing.assert_allclose(as_wrapper_sees(venv, seen, normalized=normalized), expected, rtol=1e-5)  # type: ignore[arg-type]  # no Dict
