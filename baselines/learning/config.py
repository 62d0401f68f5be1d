"""Options of a training, the same for every learner, and the presets they start from."""

import dataclasses
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal, TypeVar

import tyro

from mapp_env.validation import check_choice, check_count, check_flag, check_number

Reward = Literal["manhattan", "geodesic", "step"]
REWARDS = ("manhattan", "geodesic", "step")


@dataclass(frozen=True)
class Options:
    """Options of a training; the defaults shown are the preset's."""

    OUTPUTS: ClassVar[tuple[str, ...]] = ("joint", "agents")
    REPLAYS: ClassVar[tuple[str, ...]] = ("imagined", "stored")
    NETWORKS: ClassVar[tuple[str, ...]] = ("pairs", "paper")

    preset: Literal["default", "paper"] = "default"
    """where the other options start from; "paper": section 5 of the paper, and for what it leaves
    open the choices listed in docs/paper.md; "default": the same observation and the same
    episodes, learned from better (docs/baselines.md)"""
    seed: int = 0
    """seed of everything random: the same seed gives the same metrics.csv and the same weights"""
    out: Path | None = None
    """the run folder, new or empty; by default runs/ALGORITHM-PRESET-seedSEED-TIME"""
    resume: Path | None = None
    """a run folder whose training goes on where it stopped, with its own options"""

    grid: str = "paper-7x7"
    """bundled grid, or a map file"""
    n_agents: int = 3
    """number of agents"""
    n_landmarks: int = 5
    """number of landmarks in each problem"""
    max_cycles: int = 50
    """step limit of an episode"""
    reward: Reward = "manhattan"
    """the team reward (rule R6); the paper's is manhattan"""
    n_problems: int = 20
    """random problems to train on, one after the other"""
    episodes_per_problem: int = 30
    """consecutive episodes on each problem"""

    network: Literal["pairs", "paper"] = "pairs"
    """"paper": two layers of hidden units on the plain numbers; "pairs": cells as categories,
    landmarks as a set, agents exchangeable (baselines/networks/__init__.py)"""
    outputs: Literal["joint", "agents"] = "joint"
    """a value for each joint action (64), or for each action of each agent (12, the paper's)"""
    dueling: bool = True
    """whether the output is a value plus advantages"""
    hidden_units: int = 256
    """rectifier units in a hidden layer"""
    code_units: int = 64
    """numbers that describe an agent in the network "pairs\""""
    landmark_units: int = 0
    """numbers that describe a landmark in the network "pairs\""""
    route_units: int = 0
    """numbers that describe an agent among pairs of landmarks in the network "pairs\""""

    learning_rate: float = 0.006
    """step size of Adam"""
    learning_rate_falls: bool = True
    """whether the step size falls in a straight line to 0 over the episodes"""
    learning_rate_warmup: int = 200
    """updates over which the step size rises to its value"""
    weight_decay: float = 0.0
    """share of every weight, times the step size, that each update takes off it"""
    discount: float = 0.95
    """discount factor of future rewards"""
    reward_scale: float = 0.1
    """what rewards are multiplied by, to keep values of the order of one"""
    huber: float = 0.3
    """error at which the loss turns from a square into a line"""
    action_gap: float = 0.5
    """how much of what an action falls short of the best one in its state is taken off its target:
    advantage learning (Bellemare et al. 2016), which keeps the best action and widens the gap;
    has no effect on stored transitions"""
    double: bool = False
    """whether the network picks the next action that the target network values"""
    batch_size: int = 512
    """states in an update"""
    learning_starts: int = 500
    """steps played before the first update"""
    updates_per_episode: int = 32
    """updates after each episode"""
    update_interval: int = 0
    """steps played between two updates; 0 for none but those after episodes"""
    target_interval: int = 0
    """updates between two copies of the network to the target network; 0 to use target_rate"""
    target_rate: float = 0.03
    """how far the target network moves towards the network at each update"""

    final_reward: Literal["manhattan", "geodesic", "step", "same"] = "step"
    """reward that imagined transitions are given towards the end, or the same as before"""
    final_from: float = 0.2
    """part of the episodes after which that is so"""
    final_discount: float = 0.98
    """discount factor from then on"""
    final_reward_scale: float = 0.333
    """reward scale from then on"""

    replay: Literal["imagined", "stored"] = "imagined"
    """"stored": transitions as they were played; "imagined": experienced moves, recombined among
    agents and relabelled with fresh landmarks (baselines/replay/imagined.py)"""
    memory_size: int = 10_000
    """transitions in the replay memory, if stored; the oldest is forgotten first"""
    tried_actions: int = 2
    """joint actions tried in each imagined state: the best, then others the better the likelier"""
    temperature: float = 0.3
    """difference of value at which another action is tried e times less"""
    imagined_exploration: float = 0.05
    """probability that an imagined episode follows any of those tried, not the best"""
    imagined_from_depot: float = 0.9
    """share of imagined episodes that start at the depot with all landmarks unvisited"""
    imagined_length: int = 16
    """steps after which an imagined episode is given up"""
    imagined_retries: float = 0.9
    """probability that an episode that was given up is begun again from the depot"""

    epsilon_start: float = 1.0
    """probability at the first step that an agent takes a random action"""
    epsilon_end: float = 0.1
    """the same probability after epsilon_steps steps, and from then on"""
    epsilon_steps: int = 5_000
    """steps over which epsilon falls in a straight line"""

    guidance_start: float = 0.0
    """probability in the first episode that an agent with a close landmark in sight goes there"""
    guidance_end: float = 0.0
    """the same probability after guidance_fraction of the episodes, and from then on"""
    guidance_fraction: float = 0.8
    """part of the episodes over which the guidance falls in a straight line"""
    guidance_reach: int = 3
    """how many moves away, straight and with no wall between, a landmark is still close"""

    evaluation_problems: int = 1000
    """unseen problems for the table at the end, or all there are if they are fewer; 0 leaves out
    the table and the routes"""
    checkpoint_seconds: float = 30.0
    """seconds between two checkpoints; 0 for one after every step and update"""
    half_precision: bool = False
    """keep the policy's weights in 16 bits"""
    threads: int = 1
    """threads of PyTorch"""

    def __post_init__(self) -> None:
        check_choice("preset", self.preset, ("default", "paper"))
        check_choice("reward", self.reward, REWARDS)
        check_choice("final_reward", self.final_reward, (*REWARDS, "same"))
        check_choice("network", self.network, self.NETWORKS)
        check_choice("outputs", self.outputs, self.OUTPUTS)
        check_choice("replay", self.replay, self.REPLAYS)
        for name in ("dueling", "double", "learning_rate_falls", "half_precision"):
            check_flag(name, getattr(self, name))
        for name, low, high in COUNTS:
            check_count(name, getattr(self, name), low, high)
        for name, least, most in NUMBERS:
            check_number(name, getattr(self, name), least, most)
        if self.updates_per_episode == self.update_interval == 0:
            raise ValueError("updates_per_episode and update_interval must not both be 0")

    @property
    def n_episodes(self) -> int:
        """Episodes of the whole training."""
        return self.n_problems * self.episodes_per_problem


COUNTS = (
    ("seed", 0, 2**63 - 1),
    ("n_agents", 1, 16),
    ("n_landmarks", 1, 256),
    ("max_cycles", 1, 1_000_000),
    ("n_problems", 1, 1_000_000),
    ("episodes_per_problem", 1, 1_000_000),
    ("hidden_units", 1, 4096),
    ("code_units", 1, 4096),
    ("landmark_units", 0, 4096),
    ("route_units", 0, 4096),
    ("learning_rate_warmup", 0, 1_000_000_000),
    ("batch_size", 1, 65_536),
    ("learning_starts", 1, 1_000_000_000),
    ("updates_per_episode", 0, 1_000_000),
    ("update_interval", 0, 1_000_000),
    ("target_interval", 0, 1_000_000),
    ("memory_size", 1, 10_000_000),
    ("tried_actions", 1, 1024),
    ("imagined_length", 1, 1_000_000),
    ("epsilon_steps", 0, 1_000_000_000),
    ("guidance_reach", 1, 512),
    ("evaluation_problems", 0, 1_000_000),
    ("threads", 1, 1024),
)
NUMBERS = (
    ("learning_rate", 1e-12, 1.0),
    ("weight_decay", 0.0, 1.0),
    ("discount", 0.0, 1.0),
    ("action_gap", 0.0, 1.0),
    ("reward_scale", 1e-6, 1e6),
    ("huber", 1e-6, 1e6),
    ("target_rate", 0.0, 1.0),
    ("final_from", 0.0, 1.0),
    ("final_discount", 0.0, 1.0),
    ("final_reward_scale", 1e-6, 1e6),
    ("temperature", 1e-6, 1e6),
    ("imagined_exploration", 0.0, 1.0),
    ("imagined_from_depot", 0.0, 1.0),
    ("imagined_retries", 0.0, 1.0),
    ("epsilon_start", 0.0, 1.0),
    ("epsilon_end", 0.0, 1.0),
    ("guidance_start", 0.0, 1.0),
    ("guidance_end", 0.0, 1.0),
    ("guidance_fraction", 0.0, 1.0),
    ("checkpoint_seconds", 0.0, 1e9),
)

PRESETS: dict[str, dict[str, Any]] = {
    "default": {},
    "paper": {
        "network": "paper",
        "outputs": "agents",
        "dueling": False,
        "hidden_units": 512,
        "learning_rate": 0.001,
        "learning_rate_falls": False,
        "learning_rate_warmup": 0,
        "reward_scale": 1.0,
        "huber": 1.0,
        "batch_size": 32,
        "updates_per_episode": 0,
        "update_interval": 4,
        "target_interval": 100,
        "final_reward": "same",
        "action_gap": 0.0,
        "replay": "stored",
        "epsilon_steps": 10_000,
        "guidance_start": 1.0,
        "guidance_end": 0.1,
    },
}


def without_effect(options: Options) -> dict[str, str]:
    """Return the options that the choice of another leaves without effect, and that choice."""
    o = options
    final = ("final_reward", "final_discount", "final_reward_scale")
    choices = (
        ("network", o.network == "paper", ("code_units",)),
        ("network", o.network != "pairs", ("landmark_units", "route_units")),
        ("replay", o.replay == "stored", ("action_gap", "final_from", *final)),
        (
            "replay",
            o.replay != "imagined",
            ("tried_actions", "temperature", *(n for n in vars(o) if n.startswith("imagined_"))),
        ),
        ("replay", o.replay != "relabelled", ("fresh_as_far",)),
        ("replay", o.replay == "stored", ("fresh_landmarks",)),
        # Independent learners keep what they have seen of the others.
        ("replay", o.replay == "imagined" and "relabelled" not in o.REPLAYS, ("memory_size",)),
        ("tried_actions", o.tried_actions == 1, ("temperature", "imagined_exploration")),
        ("final_reward", o.final_reward == "same", ("final_from", *final[1:])),
        (
            "final_from",
            o.replay != "stored" and o.final_reward != "same" and o.final_from == 0.0,
            ("discount", "reward_scale"),
        ),
        ("final_from", o.final_from == 1.0, final),
        ("target_interval", o.target_interval > 0, ("target_rate",)),
        ("epsilon_start epsilon_end", o.epsilon_start == o.epsilon_end, ("epsilon_steps",)),
        ("guidance_start guidance_end", o.guidance_start == o.guidance_end, ("guidance_fraction",)),
        (
            "guidance_start guidance_end",
            o.guidance_start == o.guidance_end == 0.0,
            ("guidance_reach",),
        ),
    )
    return {
        name: " and ".join(f"{choice} {getattr(o, choice)!r}" for choice in makes_idle.split())
        for makes_idle, chosen, names in choices
        if chosen
        for name in names
    }


Chosen = TypeVar("Chosen", bound=Options)


def preset_options(kind: type[Chosen], preset: str, **changes: Any) -> Chosen:
    """Return a preset's options, with changes."""
    check_choice("preset", preset, tuple(PRESETS))
    return kind(**{"preset": preset, **PRESETS[preset], **changes})


def parse_options(
    kind: type[Chosen], description: str, words: Sequence[str] | None = None
) -> Chosen:
    """Read the options from a command line: a preset's, where nothing else is said.

    Parameters
    ----------
    kind
        Of the options.
    description
        Shown with the help.
    words
        The command line, by default that of this process.

    Raises
    ------
    ValueError
        If an option is given that another leaves without effect.
    """
    words = sys.argv[1:] if words is None else words
    preset = "default"
    for index, word in enumerate(words, start=1):
        if word.startswith("--preset="):
            preset = word.partition("=")[2]
        elif word == "--preset" and index < len(words):
            preset = words[index]
    start = preset_options(kind, preset if preset in PRESETS else "default")
    options = tyro.cli(kind, args=words, default=start, description=description)
    refuse_beside_resume(options.resume, words)
    idle = without_effect(options)
    for name in given(words):
        if name in idle:
            raise ValueError(f"{name} has no effect with {idle[name]}: leave it out")
    return options


def given(words: Sequence[str]) -> list[str]:
    """Return the names of the options that a command line sets, in its order."""
    return [option_name(word) for word in words if word.startswith("--")]


def option_name(word: str) -> str:
    """Return the name of the option that a word of a command line sets."""
    return word.partition("=")[0].removeprefix("--").replace("-", "_").removeprefix("no_")


def refuse_beside_resume(resume: Path | None, words: Sequence[str]) -> None:
    """Refuse other options beside ``resume`` on a command line, even if they are the run's own.

    Raises
    ------
    ValueError
        If there is one.
    """
    others = [name for name in given(words) if name != "resume"]
    if resume is not None and others:
        raise ValueError(f"resume goes on with the run's own options: leave out {others[0]}")


def check_resumed(options: Options) -> None:
    """Refuse other options beside ``resume``: a run goes on with its own.

    Raises
    ------
    ValueError
        If one differs from its preset.
    """
    own = preset_options(type(options), options.preset, resume=options.resume)
    for field in dataclasses.fields(options):
        if getattr(options, field.name) != getattr(own, field.name) or (
            field.name == "preset" and options.preset != "default"
        ):
            raise ValueError(f"resume goes on with the run's own options: leave out {field.name}")
