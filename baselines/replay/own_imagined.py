"""Replay by imagination for one agent by itself: its own moves anew, the others as they were seen.

An independent learner sees where all agents stand, and knows what it did itself; what the others
did and what they would do it does not know. So of its own moves it keeps which cell each has led
to, and puts them together anew, as the meta-agent does with those of all agents
(``imagined_replay``): any of its moves, among any landmarks, beside whatever the others are doing,
for agents do not influence each other's moves (rule R4). Of the others it keeps the cells it saw
them pass through. In an imagined episode each of them goes along a stretch of what was seen, from
the depot along the whole team's way in one episode; where a stretch ends, it goes on along one of
its own that was seen from the same cell. Nothing else is assumed of them.

That is the price, as in ``relabelled_replay``: where landmarks are fresh, the others' ways were
meant for those that were there, and they do not react to what the agent does now. The values are
those of the agent's own best play beside others who behave as they did.
"""

import numpy as np

from baselines.networks import NetworkSpec, network_spec, view
from baselines.replay.imagined import (
    UNKNOWN,
    ImaginedReplay,
    RelabelledReward,
    is_on,
    join,
    try_actions,
)
from baselines.replay.relabelled import rewards_of
from baselines.replay.stored import Batch, ReplayMemory
from baselines.runs.checkpoints import part


class OwnImaginedReplay(ImaginedReplay):
    """Transitions imagined from one agent's experienced moves, and the others' observed ways.

    A *moment* is a step that was played, by its number.

    Parameters
    ----------
    spec
        Of the agent's network.
    agent
        Which agent it is.
    depot
        Where episodes start.
    capacity
        Moments that are kept.
    fresh
        Share of new imagined episodes that get fresh landmarks; the others get those that were
        there when the others went where they go.
    n_rows, n_tried, temperature, exploration, from_depot, max_length, retries
        As of :class:`ImaginedReplay`; actions are the agent's own.
    """

    CHANGING = (*ImaginedReplay.CHANGING, "moments", "begins")

    def __init__(
        self,
        spec: NetworkSpec,
        agent: int,
        depot: int,
        capacity: int,
        fresh: float,
        n_rows: int,
        n_tried: int,
        temperature: float,
        exploration: float,
        from_depot: float,
        max_length: int,
        retries: float = 0.0,
    ) -> None:
        alone = network_spec("paper", 1, spec.n_landmarks, spec.n_actions, spec.n_cells, 1)
        super().__init__(
            alone,
            depot,
            n_rows,
            n_tried,
            temperature,
            exploration,
            from_depot,
            max_length,
            retries,
        )
        self.seen_as, self.agent, self.fresh = spec, agent, fresh
        n = spec.n_agents
        self.others = [other for other in range(n) if other != agent]
        self.cells = np.zeros((n_rows, n), np.int64)
        self.memory = ReplayMemory(capacity, spec.n_inputs, 1)
        self.begins = np.zeros(capacity, np.bool_)  # whether an episode began with this moment
        # The moment that each of the others is at; UNKNOWN where its stretch has ended.
        self.moments = np.full((n_rows, n - 1), UNKNOWN, np.int64)

    # -- experience

    def remember(
        self, observation: np.ndarray, actions: np.ndarray, next_observation: np.ndarray
    ) -> None:
        """Keep where the agent's own move has led, and where the others went."""
        own = [self.agent]
        self.moves[observation[own].astype(np.int64), actions] = next_observation[own]
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

    def known_actions(self, observations: np.ndarray) -> np.ndarray | None:
        """Return which of its actions the agent has made from there, (B, 1, A); None if all."""
        return super().known_actions(observations[:, [self.agent]])

    # -- imagination

    def observations(self) -> np.ndarray:
        """Return the imagined states as the agent's network is given them."""
        return self._see(self.cells, self.visited)

    def _see(self, cells: np.ndarray, visited: np.ndarray) -> np.ndarray:
        """Return states (rows, ..., N), (rows, ..., K) as the agent's network is given them."""
        landmarks = self.landmarks if cells.ndim == 2 else self.landmarks[:, None]
        return view(join(cells, landmarks, visited), self.agent, self.seen_as)

    def start_over(self, rng: np.random.Generator) -> np.ndarray:
        """Begin a new episode in each row that has ended; return these rows' numbers."""
        n, k, memory = self.seen_as.n_agents, self.spec.n_landmarks, self.memory
        solved = self.visited.all(axis=1)
        self._find_ways(np.flatnonzero(~solved & (self.ages < self.max_length)), rng)
        ended = solved | (self.ages >= self.max_length)
        rows: np.ndarray = np.flatnonzero(ended)
        count = len(rows)
        if count == 0:
            return rows
        known = self._known_cells()
        anywhere = np.append(known, self.depot)
        own_cells = anywhere[rng.integers(len(anywhere), size=count)]
        at_depot = rng.random(count) < self.from_depot
        again = ~solved[ended] & (rng.random(count) < self.retries)
        at_depot |= again
        begins = np.flatnonzero(self.begins[: len(memory)])
        first = begins[rng.integers(len(begins), size=count)]
        moments = np.where(at_depot, first, rng.integers(len(memory), size=count))
        landmarks = known[rng.random((count, len(known))).argpartition(k - 1, axis=1)[:, :k]]
        kept = rng.random(count) >= self.fresh
        landmarks[kept] = memory.arrays.observations[moments[kept], n : n + k]
        landmarks[again] = self.landmarks[ended][again]
        left = rng.integers(1, k + 1, size=count)
        cells = memory.arrays.observations[moments, :n].astype(np.int64)
        cells[:, self.agent] = np.where(at_depot, self.depot, own_cells)
        visited = (np.arange(k) >= left[:, None]) | is_on(cells, landmarks)
        # All visited already: such a row starts at the depot as well.
        over = visited.all(axis=1)
        at_depot |= over
        moments[over] = first[over]
        cells[at_depot], visited[at_depot] = self.depot, False
        self.cells[ended], self.landmarks[ended], self.visited[ended] = cells, landmarks, visited
        self.moments[ended] = self._numbers(moments)[:, None]
        self.ages[ended] = 0
        return rows

    def _numbers(self, places: np.ndarray) -> np.ndarray:
        """Return the numbers of moments at some places of the memory, which is a ring."""
        oldest = self.memory.n_added - len(self.memory)
        numbers: np.ndarray = oldest + (places - oldest) % self.memory.capacity
        return numbers

    def _find_ways(self, rows: np.ndarray, rng: np.random.Generator) -> None:
        """Let others whose stretch has ended, or is forgotten, go on along another one.

        Any that was seen of the same agent from the same cell; if there is none, the episode ends.
        """
        memory = self.memory
        oldest = memory.n_added - len(memory)
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

    def draw(  # type: ignore[override]
        self, values: np.ndarray, reward: RelabelledReward, rng: np.random.Generator
    ) -> Batch:
        """Return a transition for each row and own action tried; then let the episodes go on.

        Parameters
        ----------
        values
            (rows, A) float32, what the agent's own actions are worth in :meth:`observations`.
        reward
            How transitions are rewarded.
        rng
            Source of all choices.
        """
        n_rows, n, memory = len(self.cells), self.seen_as.n_agents, self.memory
        before = self.observations()
        after = self.cells.copy()
        for index, other in enumerate(self.others):
            places = self.moments[:, index] % memory.capacity
            after[:, other] = memory.arrays.next_observations[places, 0, other]
        # What the others do is the same whatever the agent tries.
        tried, own_cells, visited, _, done = try_actions(
            self.cells[:, [self.agent]],
            self.landmarks,
            self.visited | is_on(after[:, self.others], self.landmarks),
            values,
            rng.random((n_rows, self.n_tried)),
            self.temperature,
            self.moves,
            self.digits,
            *reward,
        )
        cells = np.repeat(after[:, None], self.n_tried, axis=1)
        cells[:, :, self.agent] = own_cells[:, :, 0]
        # Of all agents, not of this one alone.
        rewards = rewards_of(
            cells.reshape(-1, n),
            np.repeat(self.landmarks, self.n_tried, axis=0),
            visited.reshape(n_rows * self.n_tried, -1),
            reward,
        ).reshape(n_rows, self.n_tried)
        followed = np.where(
            rng.random(n_rows) < self.exploration, rng.integers(self.n_tried, size=n_rows), 0
        )
        batch = Batch(
            observations=before,
            actions=self.digits[tried],
            rewards=rewards,
            next_observations=self._see(cells, visited),
            terminated=done,
        )
        rows = np.arange(n_rows)
        self.cells, self.visited = cells[rows, followed], visited[rows, followed]
        following = self.moments + 1
        over = (following >= memory.n_added) | self.begins[following % memory.capacity]
        self.moments = np.where(over, UNKNOWN, following)
        # Where it has been but not moved from, the story ends.
        stuck = (self.moves[self.cells[:, self.agent]] == UNKNOWN).all(axis=1)
        self.ages = np.where(stuck, self.max_length, self.ages + 1)
        return batch

    # -- checkpoints

    def arrays_by_name(self) -> dict[str, np.ndarray]:
        """Return all that changes, for a checkpoint."""
        stored = self.memory.arrays_by_name()
        return {
            **super().arrays_by_name(),
            **{f"memory.{name}": array for name, array in stored.items()},
        }

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Take over what :meth:`arrays_by_name` returned."""
        self.memory.restore(part(arrays, "memory"))
        super().restore(arrays)
