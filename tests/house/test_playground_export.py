"""The weights of the page in docs/playground: what is in the file, and what is refused."""

import base64
import json
import re

import numpy as np
import pytest
import torch

from baselines.export_playground import COMMAND, PLAYGROUND, Args, export, kept_rows
from baselines.networks import build_network, network_spec, torch_generator
from baselines.networks.pairs import arrange, between_landmarks, routes
from baselines.policies.policy import load_policy, save_policy
from mapp_env import Grid, make_grid, make_vec
from mapp_env.rendering import palette

GRID = make_grid()
PAIRS = {"kind": "pairs", "outputs": "joint"}
OPTIONS = {"n_agents": 3, "n_landmarks": 5, "max_cycles": 50}


def save_run(folder, grid=GRID, spec=None, large=None, **options):
    """Save a small network as a run folder."""
    options = {**OPTIONS, **options}
    shape = (options["n_agents"], options["n_landmarks"], 4, grid.n_cells, 8)
    kind = {**PAIRS, **(spec or {})}
    network = build_network(
        network_spec(kind.pop("kind"), *shape, **kind), torch_generator(np.random.SeedSequence(0))
    )
    if large is not None:
        with torch.no_grad():
            network.head.advantages.bias[0] = large
    save_policy(folder / "policy.safetensors", network, grid)
    config = {"grid": grid.to_text(), "options": options, "training_problems": []}
    (folder / "config.json").write_text(json.dumps(config), encoding="utf-8")
    return str(folder)


def test_the_pages_weights_are_the_policys():
    """weights.js is, byte for byte, what the export makes of the pretrained policy."""
    found = (PLAYGROUND / "weights.js").read_bytes()
    assert found == export("pretrained").encode(), (
        f"docs/playground/weights.js is not of the present `pretrained`: run `{COMMAND}`"
    )


def test_the_file_holds_the_rounded_weights():
    """A tensor read back is the policy's, rounded to 16 bits; of tables the kept rows."""
    script = export("pretrained")
    body = script[script.index("policy = ") + len("policy = ") : script.rindex(";")]
    about = json.loads(body)
    policy = load_policy("pretrained")
    assert about["spec"] == policy.spec.as_dict()
    rows = kept_rows(policy.spec, GRID)
    for name, tensor in policy.network.state_dict().items():
        entry = about["tensors"][name]
        values = np.frombuffer(base64.b64decode(entry["data"]), "<f2").reshape(entry["shape"])
        table = name.removesuffix(".weight")
        expected = tensor.numpy()[rows[table]] if table in rows else tensor.numpy()
        np.testing.assert_array_equal(values, expected.astype(np.float16))


def test_kept_rows_are_those_looked_up():
    """Whatever random episodes look up is kept, and what no grid cell can mean is not."""
    spec = network_spec("pairs", 3, 5, 4, 49, 8, outputs="joint")
    rows = kept_rows(spec, GRID)
    kept = {name: set(numbers.tolist()) for name, numbers in rows.items()}
    assert all(len(kept[name]) == len(numbers) for name, numbers in rows.items())
    envs = make_vec(512, grid=GRID)
    seen, _ = envs.reset(seed=0)
    for _ in range(60):
        pairs, landmarks, _ = arrange(seen, 3, 5, 49, True)
        slots = np.arange(3)[:, None] * 49 * 51
        assert set(pairs.ravel().tolist()) <= kept["pairs"]
        assert set((pairs[:, :, :5] + slots).ravel().tolist()) <= kept["crossed"]
        assert set(landmarks.ravel().tolist()) <= kept["unvisited"]
        assert set(routes(pairs, landmarks, 49).ravel().tolist()) <= kept["routes"]
        assert set(between_landmarks(landmarks, 49).ravel().tolist()) <= kept["between"]
        seen, *_ = envs.step(envs.action_space.sample())
    envs.close()
    free = 41
    assert len(kept["pairs"]) == free * 42 - 40  # but an agent on an unvisited landmark
    assert len(kept["routes"]) == 40 * 39 * 38 // 2 + 40 * 39 // 2 + 1


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"grid": Grid.from_text("D......\n" + ".......\n" * 6)}, "another grid than the page's"),
        ({"n_agents": 2}, "has n_agents=2, the page 3"),
        ({"n_landmarks": 4}, "has n_landmarks=4, the page 5"),
        ({"max_cycles": 60}, "has max_cycles=60, the page 50"),
        ({"spec": {"kind": "paper"}}, "kind='paper', the page runs 'pairs'"),
        ({"spec": {"outputs": "agents"}}, "outputs='agents', the page runs 'joint'"),
        ({"spec": {"outputs": "agents", "team": "independent"}}, "the page runs"),
        ({"large": 1e6}, "head.advantages.bias holds more than 16 bits have room for"),
    ],
)
def test_what_the_page_cannot_run_is_refused(changes, said, tmp_path):
    """A policy of another setting or kind, or with weights too large, is refused by name."""
    run = save_run(tmp_path, **changes)
    with pytest.raises(ValueError, match=re.escape(said)) as error:
        export(run)
    assert repr(run) in str(error.value)


def test_a_run_of_the_pages_setting_is_taken(tmp_path):
    """The policy that the refused ones above differ from in one thing is exported."""
    assert '"head.advantages.bias"' in export(save_run(tmp_path))


def test_where_to_write_is_no_matter_where_nothing_is_written(tmp_path):
    """Counting what rounding changes takes no file."""
    with pytest.raises(ValueError, match="out has no effect with rounding"):
        Args(out=tmp_path / "weights.js", rounding=True)


def test_the_pages_colours_are_the_palettes():
    """In the light, the page has the colours of all other pictures."""
    style = (PLAYGROUND / "style.css").read_text(encoding="utf-8").split("@media")[0]
    found = dict(re.findall(r"--([\w-]+): (#[0-9a-f]{6});", style))
    # The page marks no steps that lost something.
    names = [name for name in vars(palette) if name.isupper() and name not in {"AGENTS", "LOST"}]
    assert len(names) == 12
    for name in names:
        assert found[name.lower().replace("_", "-")] == palette.to_hex(getattr(palette, name))
    for agent in range(3):
        colour = palette.agent_colour(agent)
        assert found[f"agent-{agent}"] == palette.to_hex(colour)
        assert found[f"on-agent-{agent}"] == palette.to_hex(palette.ink_on(colour))
