"""Checkpoints: whole or not at all, and refused when anything about them is wrong."""

import re

import numpy as np
import pytest

from baselines.runs.checkpoints import CheckpointError, Checkpoints
from mapp_env import files

CONFIG = {"algorithm": "meta_dqn", "options": {"seed": 1}}


def content(number: int) -> tuple[dict[str, np.ndarray], dict[str, object]]:
    """Return what a learner might save: arrays of several types, a generator's huge integers."""
    rng = np.random.default_rng(number)
    arrays = {
        "network.weight": rng.normal(size=(3, 4)).astype(np.float32),
        "memory.cells": rng.integers(49, size=(7, 3)),
        "memory.terminated": rng.random(7) < 0.5,
        "torch": rng.integers(256, size=16, dtype=np.uint8),
        "empty": np.zeros((0, 3), np.float64),
        "scalar": np.array(number),
        "transposed": rng.normal(size=(3, 2)).T,
    }
    return arrays, {"steps": number, "rng": rng.bit_generator.state, "loss": 0.1 + number}


def save(folder, *numbers: int, config=CONFIG) -> Checkpoints:
    """Write checkpoints."""
    checkpoints = Checkpoints(folder, config)
    for number in numbers:
        checkpoints.save(number, *content(number))
    return checkpoints


def test_what_was_saved_is_loaded(tmp_path):
    """Arrays with their types and shapes, integers of 128 bits, every bit of a float."""
    loaded, problems = save(tmp_path, 5).latest()
    arrays, state = content(5)
    assert problems == []
    assert loaded.number == 5
    assert loaded.state == state
    assert loaded.arrays.keys() == arrays.keys()
    for name, array in arrays.items():
        assert loaded.arrays[name].dtype == array.dtype
        assert loaded.arrays[name].shape == array.shape
        np.testing.assert_array_equal(loaded.arrays[name], array)


def test_the_last_two_are_kept(tmp_path):
    """Older ones are deleted, and so are the arrays of one that never came to be."""
    checkpoints = save(tmp_path, 1, 2)
    (checkpoints.folder / f"{3:012d}.safetensors").write_text("half")
    checkpoints.save(10, *content(10))
    names = sorted(path.name for path in checkpoints.folder.iterdir())
    assert names == [f"{n:012d}.{kind}" for n in (2, 10) for kind in ("json", "safetensors")]
    assert checkpoints.numbers() == [2, 10]


def test_what_was_just_saved_is_kept(tmp_path):
    """However many newer ones there are that cannot be used, the last two that can be stay."""
    checkpoints = save(tmp_path, 1)
    for number in (50, 60):
        (checkpoints.folder / f"{number:012d}.json").write_text("damaged")
    for number in (2, 3, 4):
        checkpoints.save(number, *content(number))
        assert checkpoints.latest()[0].number == number
    assert checkpoints.numbers() == [3, 4, 50, 60]


def test_the_start_is_no_substitute(tmp_path):
    """With the later ones damaged a run is not begun anew without a question."""
    checkpoints = save(tmp_path, 0)
    assert checkpoints.latest()[0].number == 0
    checkpoints.save(7, *content(7))
    (checkpoints.folder / f"{7:012d}.safetensors").write_bytes(b"damaged")
    with pytest.raises(CheckpointError, match=r"no checkpoint can be used: .*000000000007"):
        checkpoints.latest()


def test_no_checkpoint_is_no_error(tmp_path):
    """A run that was stopped before its first checkpoint starts anew."""
    assert Checkpoints(tmp_path, CONFIG).latest() == (None, [])


@pytest.mark.parametrize("suffix", ["json", "safetensors"])
def test_every_changed_byte_is_noticed(tmp_path, suffix):
    """Whichever byte of whichever part changes, the one before is used, with a message."""
    checkpoints = save(tmp_path, 1, 2)
    path = checkpoints.folder / f"{2:012d}.{suffix}"
    whole = path.read_bytes()
    places = np.random.default_rng(0).choice(len(whole) - 1, size=60, replace=False)
    for place in places.tolist():
        broken = bytearray(whole)
        broken[place] ^= 1 << place % 8
        path.write_bytes(broken)
        loaded, problems = checkpoints.latest()
        assert loaded.number == 1
        assert len(problems) == 1
        assert str(path) in problems[0]
    for length in (0, 1, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        assert checkpoints.latest()[0].number == 1
    path.write_bytes(whole)
    assert checkpoints.latest()[0].number == 2


def test_missing_parts_are_noticed(tmp_path):
    """Without its arrays a checkpoint is refused; arrays without their JSON are none."""
    checkpoints = save(tmp_path, 1, 2)
    (checkpoints.folder / f"{2:012d}.safetensors").unlink()
    loaded, problems = checkpoints.latest()
    assert loaded.number == 1
    assert re.search(r"000000000002\.safetensors: .*cannot be opened as a checkpoint", problems[0])
    (checkpoints.folder / f"{2:012d}.json").unlink()
    assert checkpoints.latest()[1] == []
    (checkpoints.folder / f"{1:012d}.safetensors").unlink()
    with pytest.raises(CheckpointError, match="no checkpoint can be used"):
        checkpoints.latest()


def test_parts_of_two_checkpoints_do_not_mix(tmp_path):
    """Arrays of another moment, or a file under another number, are refused."""
    checkpoints = save(tmp_path, 1, 2)
    one, two = (checkpoints.folder / f"{n:012d}.safetensors" for n in (1, 2))
    two.write_bytes(one.read_bytes())
    with pytest.raises(CheckpointError, match="digest differs"):
        checkpoints.load(2)
    (checkpoints.folder / f"{2:012d}.json").write_bytes(
        (checkpoints.folder / f"{1:012d}.json").read_bytes()
    )
    with pytest.raises(CheckpointError, match="of another version or number"):
        checkpoints.load(2)


def test_another_config_is_refused(tmp_path):
    """A checkpoint of a run with another seed does not fit."""
    save(tmp_path, 1)
    other = Checkpoints(tmp_path, {**CONFIG, "options": {"seed": 2}})
    with pytest.raises(CheckpointError, match="belongs to a run with another config"):
        other.latest()


@pytest.mark.parametrize(
    "text", ["", "{}", "[1]", "nonsense", "[" * 100_000, '{"format": "x", "format": "x"}', "NaN"]
)
def test_nonsense_is_refused(tmp_path, text):
    """What is no JSON object of ours is refused by name, however deeply nested."""
    checkpoints = save(tmp_path, 1)
    path = checkpoints.folder / f"{1:012d}.json"
    path.write_text(text)
    with pytest.raises(CheckpointError, match=r"000000000001\.json"):
        checkpoints.load(1)


@pytest.mark.parametrize("writes", [0, 1])
def test_a_failed_save_leaves_the_old_ones(tmp_path, monkeypatch, writes):
    """If the disk is full at either part, the error is passed on and the old ones stand."""
    checkpoints = save(tmp_path, 1, 2)
    done = []
    replace = files._replace

    def failing(path, data):
        if len(done) == writes:
            raise OSError(28, "No space left on device")
        done.append(path)
        replace(path, data)

    monkeypatch.setattr(files, "_replace", failing)
    with pytest.raises(ValueError, match=r"cannot be written: .*No space left"):
        checkpoints.save(3, *content(3))
    assert checkpoints.numbers() == [1, 2]
    assert checkpoints.latest()[0].number == 2


def test_no_infinity_gets_into_a_file(tmp_path):
    """What JSON cannot hold is refused when it is written, not when it is read."""
    with pytest.raises(ValueError, match="JSON compliant"):
        Checkpoints(tmp_path, CONFIG).save(1, {}, {"loss": float("nan")})
