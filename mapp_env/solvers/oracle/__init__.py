"""The optimum from any state, for many states at once: what every single decision costs.

A state is what the rest of an episode depends on: where each agent stands, and which landmarks are
left. The shortest ways through every set of landmarks are found from their ends (Held and Karp
1962), so that they serve agents that start anywhere; then each agent is joined to those before it,
by the best partition of every set.
"""

from mapp_env.solvers.oracle.decisions import next_costs, next_costs_of, regrets

__all__ = ["next_costs", "next_costs_of", "regrets"]
