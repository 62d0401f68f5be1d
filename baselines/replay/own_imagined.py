"""Replay by imagination for one agent by itself: its own moves anew, the others as they were seen.

An independent learner sees where all agents stand, and knows what it did itself; what the others
did and what they would do it does not know. So of its own moves it keeps which cell each has led
to, and puts them together anew, as the meta-agent does with those of all agents
(``imagined.py``): any of its moves, among any landmarks, beside whatever the others are doing,
for agents do not influence each other's moves (rule R4). Of the others it keeps the cells it saw
them pass through. In an imagined episode each of them goes along a stretch of what was seen, from
the depot along the whole team's way in one episode; where a stretch ends, it goes on along one of
its own that was seen from the same cell. Nothing else is assumed of them.

That is the price, as in ``relabelled.py``: where landmarks are fresh, the others' ways were
meant for those that were there, and they do not react to what the agent does now. The values are
those of the agent's own best play beside others who behave as they did.
"""

from typing import Any

import numpy as np

from baselines.networks import NetworkSpec, view
from baselines.replay.imagined import UNKNOWN, ImaginedReplay
from baselines.replay.relabelled import RelabelledReward, draw_landmarks
from baselines.replay.stored import Batch, ReplayMemory
from baselines.runs.checkpoints import joined, part
from mapp_env import Grid


class OwnImaginedReplay(ImaginedReplay):
    """Transitions imagined from one agent's experienced moves, and the others' observed ways.

    A *moment* is a step that was played, by its number; `capacity` of them are kept. A share of new
    imagined episodes, `fresh`, get fresh landmarks; the rest get those that were there when the
    others went where they go. Actions are the agent's own.
    """

    CHANGING = (*ImaginedReplay.CHANGING, "moments", "begins")
    PRODUCT = np.float32

    def __init__(
        self,
        spec: NetworkSpec,
        grid: Grid,
        agent: int,
        *,
        capacity: int,
        fresh: float,
        **options: Any,  # of ImaginedReplay
    ) -> None:
        super().__init__(spec, grid, [agent], **options)
        self.agent, self.fresh = agent, fresh
        self.others = [other for other in range(spec.n_agents) if other != agent]
        self.memory = ReplayMemory(capacity, spec.n_inputs, 1)
        self.begins = np.zeros(capacity, np.bool_)  # whether an episode began with this moment
        # The moment that each of the others is at; UNKNOWN where its stretch has ended.
        self.moments = np.full((len(self.cells), len(self.others)), UNKNOWN, np.int64)

    # -- experience

    def add(
        self,
        observation: np.ndarray,
        actions: np.ndarray,
        reward: float,
        next_observation: np.ndarray,
        terminated: bool,
    ) -> None:
        """Keep where the agent's own move has led, and where the others went."""
        super().add(observation, actions, reward, next_observation, terminated)
        memory = self.memory
        last = memory.arrays.next_observations[(memory.n_added - 1) % memory.capacity, 0]
        self.begins[memory.n_added % memory.capacity] = (
            memory.n_added == 0 or (observation != last).any()
        )
        memory.add(observation, actions, 0.0, next_observation, False)

    @property
    def ready(self) -> bool:
        """Whether enough cells are known to place landmarks, and the beginning of an episode."""
        return super().ready and bool(self.begins[: len(self.memory)].any())

    # -- imagination

    def _observe(self, cells: np.ndarray, landmarks: np.ndarray, visited: np.ndarray) -> np.ndarray:
        return view(super()._observe(cells, landmarks, visited), self.agent, self.spec)

    def start_over(self, rng: np.random.Generator) -> np.ndarray:
        """Begin a new episode in each row that has ended; return these rows' numbers."""
        n, k, memory = self.spec.n_agents, self.spec.n_landmarks, self.memory
        self._find_ways(rng)
        solved, rows = self._ended()
        count = len(rows)
        if count == 0:
            return rows
        known = self._known_cells()
        anywhere = np.append(known, self.depot)
        own_cells = anywhere[rng.integers(len(anywhere), size=count)]
        at_depot = rng.random(count) < self.from_depot
        again = ~solved[rows] & (rng.random(count) < self.retries)
        # From the depot the others go as they went in one episode, from its beginning on.
        begins = np.flatnonzero(self.begins[: len(memory)])
        first = begins[rng.integers(len(begins), size=count)]
        moments = np.where(at_depot | again, first, rng.integers(len(memory), size=count))
        landmarks = draw_landmarks(known, count, k, rng)
        kept = rng.random(count) >= self.fresh
        landmarks[kept] = memory.arrays.observations[moments[kept], n : n + k]
        cells = memory.arrays.observations[moments, :n].astype(np.int64)
        cells[:, self.agent] = np.where(at_depot | again, self.depot, own_cells)
        at_depot = self._begin(rows, cells, landmarks, at_depot, again, rng)
        self.moments[rows] = self._numbers(np.where(at_depot, first, moments))[:, None]
        return rows

    def _numbers(self, places: np.ndarray) -> np.ndarray:
        """Return the numbers of moments at some places of the memory, which is a ring."""
        oldest = self.memory.n_added - len(self.memory)
        numbers: np.ndarray = oldest + (places - oldest) % self.memory.capacity
        return numbers

    def _find_ways(self, rng: np.random.Generator) -> None:
        """Let others whose stretch has ended, or is forgotten, go on along another one.

        Any that was seen of the same agent from the same cell; if there is none, the episode ends.
        """
        memory = self.memory
        oldest = memory.n_added - len(memory)
        rows = np.flatnonzero(~self.visited.all(axis=1) & (self.ages < self.max_length))
        for index, other in enumerate(self.others):
            lost = rows[self.moments[rows, index] < max(oldest, 0)]
            if not len(lost):
                continue
            stood = memory.arrays.observations[: len(memory), other].astype(np.int64)
            order = stood.argsort(kind="stable")
            wanted = self.cells[lost, other]
            low = stood.searchsorted(wanted, "left", order)
            count = stood.searchsorted(wanted, "right", order) - low
            places = low + (rng.random(len(lost)) * count).astype(np.int64)
            found = count > 0
            self.moments[lost[found], index] = self._numbers(order[places[found]])
            self.ages[lost[~found]] = self.max_length

    def _others_move(self) -> np.ndarray:
        after, memory = self.cells.copy(), self.memory
        for index, other in enumerate(self.others):
            places = self.moments[:, index] % memory.capacity
            after[:, other] = memory.arrays.next_observations[places, 0, other]
        return after

    def draw(
        self, values: np.ndarray, reward: RelabelledReward, rng: np.random.Generator
    ) -> tuple[Batch, np.ndarray]:
        """Do what :meth:`ImaginedReplay.draw` does; the others go on along their stretches."""
        drawn = super().draw(values, reward, rng)
        next_moments = self.moments + 1
        capacity = self.memory.capacity
        over = (next_moments >= self.memory.n_added) | self.begins[next_moments % capacity]
        self.moments = np.where(over, UNKNOWN, next_moments)
        return drawn

    # -- checkpoints

    def arrays_by_name(self) -> dict[str, np.ndarray]:
        """Return all that changes."""
        return super().arrays_by_name() | joined({"memory": self.memory.arrays_by_name()})

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Take over what :meth:`arrays_by_name` returned."""
        self.memory.restore(part(arrays, "memory"))
        super().restore(arrays)
