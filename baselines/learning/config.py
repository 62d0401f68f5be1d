"""Options of a training, the presets they start from, and how they are read."""

import dataclasses
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NoReturn, TypeVar

import tyro

from baselines.learning.ranges import Positive, Share, Within, allowed_values, check_options
from baselines.networks import CENTRAL
from baselines.runs.folder import read_config
from mapp_env.engine import rules
from mapp_env.validation import check_choice

REWARDS = tuple(kind.name.lower() for kind in rules.Reward)
Reward = Literal[REWARDS]  # type: ignore[valid-type]
FORMER_NAMES = {"--huber": "--huber-delta", "--sharpness": "--inverse-temperature"}
TASK = ("n_agents", "n_landmarks", "max_cycles")  # in each run's config, options of it or not
Units = Annotated[int, Within(1, 4096)]
UnitsOrNone = Annotated[int, Within(0, 4096)]


@dataclass(frozen=True)
class RunOptions:
    """Options of any training."""

    PRESETS: ClassVar[dict[str, dict[str, Any]]] = {"default": {}}

    seed: Annotated[int, Within(0, 2**63 - 1)] = 0
    """seed of everything random: the same seed gives the same metrics.csv and the same weights"""
    out: Path | None = None
    """the run folder, new or empty; by default runs/ALGORITHM-PRESET-seedSEED-TIME"""
    resume: Path | None = None
    """run folder to resume, with its own options"""
    evaluation_problems: Annotated[int, Within(0, 1_000_000)] = 1000
    """unseen problems for the table at the end, or all there are if they are fewer; 0 for none"""
    checkpoint_seconds: Annotated[float, Within(0.0, 1e9)] = 30.0
    """seconds between two checkpoints; 0 for one after every step and update"""
    half_precision: bool = False
    """keep the policy's weights in 16 bits"""
    threads: Annotated[int, Within(1, 1024)] = 1
    """threads of PyTorch"""

    def __post_init__(self) -> None:
        check_options(self)


@dataclass(frozen=True)
class Options(RunOptions):
    """Options of a deep Q-learning; the defaults shown are the preset's."""

    PRESETS: ClassVar[dict[str, dict[str, Any]]] = {
        "default": {},
        "paper": {
            "preset": "paper",
            "network": "paper",
            "outputs": "agents",
            "dueling": False,
            "hidden_units": 512,
            "learning_rate": 0.001,
            "learning_rate_falls": False,
            "learning_rate_warmup": 0,
            "reward_scale": 1.0,
            "huber_delta": 1.0,
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

    preset: Literal["default", "paper"] = "default"
    """preset of the other options; "paper": section 5 of the paper, and for what it leaves
    open the choices listed in docs/paper.md; "default": the same observation and the same
    episodes, learned from better (docs/baselines.md)"""

    grid: str = "paper-7x7"
    """bundled grid, or a map file"""
    n_agents: Annotated[int, Within(1, 16)] = 3
    """number of agents"""
    n_landmarks: Annotated[int, Within(1, 256)] = 5
    """number of landmarks in each problem"""
    max_cycles: Annotated[int, Within(1, 1_000_000)] = 50
    """step limit of an episode"""
    reward: Reward = "manhattan"
    """the team reward (rule R6); the paper's is manhattan"""
    n_problems: Annotated[int, Within(1, 1_000_000)] = 20
    """random problems to train on, one after the other"""
    episodes_per_problem: Annotated[int, Within(1, 1_000_000)] = 30
    """consecutive episodes on each problem"""

    network: Literal[CENTRAL] = "pairs"  # type: ignore[valid-type]
    """"paper": two layers of hidden units on the plain numbers; "pairs": cells as categories,
    landmarks as a set, agents exchangeable (baselines/networks/pairs.py)"""
    outputs: Literal["joint", "agents"] = "joint"
    """a value for each joint action (64), or for each action of each agent (12, the paper's)"""
    dueling: bool = True
    """whether the output is a value plus advantages"""
    hidden_units: Units = 256
    """rectifier units in a hidden layer"""
    code_units: Units = 64
    """numbers that describe an agent in the network "pairs\""""
    landmark_units: UnitsOrNone = 0
    """numbers that describe a landmark in the network "pairs\""""
    route_units: UnitsOrNone = 0
    """numbers that describe an agent among pairs of landmarks in the network "pairs\""""

    learning_rate: Annotated[float, Within(1e-12, 1.0)] = 0.006
    """step size of Adam"""
    learning_rate_falls: bool = True
    """whether the learning rate decays linearly to 0 over the episodes"""
    learning_rate_warmup: Annotated[int, Within(0, 1_000_000_000)] = 200
    """updates of linear learning-rate warm-up"""
    weight_decay: Share = 0.0
    """share of every weight, times the step size, that each update takes off it"""
    discount: Share = 0.95
    """discount factor of future rewards"""
    reward_scale: Positive = 0.1
    """factor for rewards, to keep values of the order of one"""
    huber_delta: Positive = 0.3
    """error at which the Huber loss changes from quadratic to linear"""
    action_gap: Share = 0.5
    """fraction of an action's gap to the best one in its state to subtract from its target:
    advantage learning (Bellemare et al. 2016), which keeps the best action and widens the gap;
    has no effect on stored transitions"""
    double: bool = False
    """whether the network picks the next action that the target network values"""
    batch_size: Annotated[int, Within(1, 65_536)] = 512
    """states in an update"""
    learning_starts: Annotated[int, Within(1, 1_000_000_000)] = 500
    """steps played before the first update"""
    updates_per_episode: Annotated[int, Within(0, 1_000_000)] = 32
    """updates after each episode"""
    update_interval: Annotated[int, Within(0, 1_000_000)] = 0
    """steps played between two updates; 0 for none but those after episodes"""
    target_interval: Annotated[int, Within(0, 1_000_000)] = 0
    """updates between two copies of the network to the target network; 0 to use target_rate"""
    target_rate: Share = 0.03
    """fraction by which the target network moves towards the network at each update"""

    final_reward: Literal[Reward, "same"] = "step"
    """reward of imagined transitions in the final phase, or the same as before"""
    final_from: Share = 0.2
    """fraction of the episodes after which the final phase begins"""
    final_discount: Share = 0.98
    """discount factor in the final phase"""
    final_reward_scale: Positive = 0.333
    """reward scale in the final phase"""

    replay: Literal["imagined", "stored"] = "imagined"
    """"stored": transitions as they were played; "imagined": experienced moves, recombined among
    agents and relabelled with fresh landmarks (baselines/replay/imagined.py)"""
    memory_size: Annotated[int, Within(1, 10_000_000)] = 10_000
    """transitions in the replay memory, if stored; the oldest is forgotten first"""
    tried_actions: Annotated[int, Within(1, 1024)] = 2
    """joint actions tried in each imagined state: the best, then others, better ones more often"""
    temperature: Positive = 0.3
    """Boltzmann temperature: an action whose value is lower by this is tried e times less often"""
    imagined_exploration: Share = 0.05
    """probability that an imagined episode follows any of those tried, not the best"""
    imagined_from_depot: Share = 0.9
    """share of imagined episodes that start at the depot with all landmarks unvisited"""
    imagined_length: Annotated[int, Within(1, 1_000_000)] = 16
    """step limit of an imagined episode"""
    imagined_retries: Share = 0.9
    """probability that an episode that reached this limit restarts from the depot"""

    epsilon_start: Share = 1.0
    """probability at the first step that an agent takes a random action"""
    epsilon_end: Share = 0.1
    """the same probability after epsilon_steps steps, and from then on"""
    epsilon_steps: Annotated[int, Within(0, 1_000_000_000)] = 5_000
    """steps over which epsilon falls in a straight line"""

    guidance_start: Share = 0.0
    """probability in the first episode that an agent with a close landmark in sight goes there"""
    guidance_end: Share = 0.0
    """the same probability after guidance_fraction of the episodes, and from then on"""
    guidance_fraction: Share = 0.8
    """part of the episodes over which the guidance falls in a straight line"""
    guidance_reach: Annotated[int, Within(1, 512)] = 3
    """most moves, in a straight line without walls, at which a landmark counts as close"""

    prefetch: bool = True
    """whether the next batch is drawn in a second thread; the weights are the same"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.updates_per_episode == self.update_interval == 0:
            raise ValueError("updates_per_episode and update_interval must not both be 0")

    @property
    def n_episodes(self) -> int:
        """Episodes of the whole training."""
        return self.n_problems * self.episodes_per_problem


def without_effect(options: Options) -> dict[str, str]:
    """Return the options that have no effect, each with the option that disables it."""
    o = options
    replay: str = o.replay  # that of independent learners has one more
    final = ("final_reward", "final_discount", "final_reward_scale")
    relabels = "relabelled" in allowed_values(type(options), "replay")
    choices = (
        ("network", o.network == "paper", ("code_units",)),
        ("network", o.network != "pairs", ("landmark_units", "route_units")),
        ("replay", o.replay == "stored", ("action_gap", "final_from", *final)),
        (
            "replay",
            o.replay != "imagined",
            ("tried_actions", "temperature", *(n for n in vars(o) if n.startswith("imagined_"))),
        ),
        ("replay", replay != "relabelled", ("fresh_as_far",)),
        ("replay", o.replay == "stored", ("fresh_landmarks",)),
        # Independent learners keep what the others did.
        ("replay", o.replay == "imagined" and not relabels, ("memory_size",)),
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


Chosen = TypeVar("Chosen", bound=RunOptions)


def preset_options(kind: type[Chosen], preset: str, **changes: Any) -> Chosen:
    """Return a preset's options, with changes."""
    check_choice("preset", preset, tuple(kind.PRESETS))
    return kind(**{**kind.PRESETS[preset], **changes})


# -- the command line --------------------------------------------------------------------------


def parse_options(
    kind: type[Chosen], description: str, words: Sequence[str] | None = None
) -> Chosen:
    """Read the options from a command line, by default this process's; the preset gives the others.

    Raises a ValueError if an option is given that another leaves without effect, or any beside
    ``resume``, even if it has the run's own value.
    """
    words = [_current(word) for word in (sys.argv[1:] if words is None else words)]
    preset = "default"
    for index, word in enumerate(words, start=1):
        if word.startswith("--preset="):
            preset = word.partition("=")[2]
        elif word == "--preset" and index < len(words):
            preset = words[index]
    start = preset_options(kind, preset if preset in kind.PRESETS else "default")
    options = tyro.cli(kind, args=words, default=start, description=description)
    idle = without_effect(options) if isinstance(options, Options) else {}
    for name in (option_name(word) for word in words if word.startswith("--")):
        if options.resume is not None and name != "resume":
            raise ValueError(f"resume goes on with the run's own options: leave out {name}")
        if name in idle:
            raise ValueError(f"{name} has no effect with {idle[name]}: leave it out")
    return options


def _current(word: str) -> str:
    """Return a word of a command line with an option's present name."""
    name, equals, value = word.partition("=")
    return FORMER_NAMES.get(name, name) + equals + value


def option_name(word: str) -> str:
    """Return the name of the option that a word of a command line sets."""
    return word.partition("=")[0].removeprefix("--").replace("-", "_").removeprefix("no_")


def run_script(
    main: Callable[..., int | None], kind: type, description: str | None, others: bool = False
) -> NoReturn:
    """Read a script's options, run it, and exit: with code 1 and a line if something is refused.

    With `others`, words of the command line that are no options of its own are given to it, too.
    """
    try:
        if issubclass(kind, RunOptions):
            sys.exit(main(parse_options(kind, description or "")))
        read = tyro.cli(kind, description=description, return_unknown_args=others)
        sys.exit(main(*read) if others else main(read))
    except ValueError as error:
        raise SystemExit(f"error: {error}") from error


# -- a run that is resumed ---------------------------------------------------------------------


def own_options(args: Chosen, algorithm: str) -> Chosen:
    """Return a run's options: if it is resumed, those it was started with.

    Raises a ValueError if others are given beside ``resume``, or the folder holds no run of this
    algorithm and version.
    """
    folder, kind = args.resume, type(args)
    if folder is None:
        return args
    names = [field.name for field in dataclasses.fields(kind)]
    for name in names:
        if getattr(args, name) != getattr(kind(resume=folder), name):
            raise ValueError(f"resume goes on with the run's own options: leave out {name}")
    config = read_config(folder)
    if config.get("algorithm") != algorithm:
        raise ValueError(f"{folder}: a run of {config.get('algorithm')!r}, not of {algorithm}")
    options = config.get("options")
    if not isinstance(options, dict) or not {*names} <= {*options} <= {*names, *TASK}:
        raise ValueError(f"{folder}: its options are not those of this version")
    try:
        return kind(**{name: options[name] for name in names} | {"out": None, "resume": folder})
    except (TypeError, ValueError) as error:
        raise ValueError(f"{folder}: {error}") from error
