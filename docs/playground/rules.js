/* What the rules make of joint actions: tours, claims and costs, as mapp_env.replay does. */
"use strict";

(function (mapp) {
  /**
   * Play an episode until every landmark is visited, the step limit, or the commander stops.
   *
   * `command(cells, visited, step)` returns the joint action, or null to stop. Landmarks are cells.
   */
  function play(grid, landmarks, nAgents, maxCycles, command) {
    const cells = [new Array(nAgents).fill(grid.depot)];
    const visited = landmarks.map(() => false);
    const claims = Array.from({ length: nAgents }, () => []);
    const actions = [];
    while (visited.includes(false) && actions.length < maxCycles) {
      const action = command(cells[cells.length - 1], visited, actions.length);
      if (action === null) break;
      actions.push(action);
      const now = cells[cells.length - 1].map((cell, agent) => grid.moves[cell][action[agent]]);
      cells.push(now);
      landmarks.forEach((landmark, index) => {
        const agent = now.indexOf(landmark); // in one step: the agent of the lowest index
        if (agent >= 0 && !visited[index]) {
          visited[index] = true;
          claims[agent].push({ landmark, step: actions.length });
        }
      });
    }
    const success = !visited.includes(false);
    const left = landmarks.filter((_, index) => !visited[index]);
    const plan = { actions, cells, claims, success, left, steps: actions.length };
    plan.walks = claims.map((_, agent) => walk(grid, plan, agent));
    return Object.assign(plan, measure(grid, plan));
  }

  /**
   * Return where an agent is after each step: commanded up to its last claim, then on the shortest
   * way home (R8). `end` is the step of its last claim; without a claim it stays at home. In an
   * episode that is not solved it is where it was commanded to, to the end.
   */
  function walk(grid, plan, agent) {
    const own = plan.cells.map((row) => row[agent]);
    if (!plan.success) return { cells: own, end: own.length - 1 };
    const claims = plan.claims[agent];
    if (!claims.length) return { cells: [grid.depot], end: 0 };
    const { landmark, step } = claims[claims.length - 1];
    const home = mapp.shortestPath(grid, landmark, grid.depot).slice(1);
    return { cells: [...own.slice(0, step + 1), ...home], end: step };
  }

  /** Return the costs of a plan; infinite if a landmark is left. */
  function measure(grid, plan) {
    if (!plan.success) return { coverTime: Infinity, makespan: Infinity, totalDistance: Infinity };
    const moved = ({ cells }) => cells.filter((cell, step) => step && cell !== cells[step - 1]);
    return {
      coverTime: plan.steps,
      makespan: Math.max(...plan.walks.map(({ cells }) => cells.length - 1)),
      totalDistance: plan.walks.reduce((sum, one) => sum + moved(one).length, 0),
    };
  }

  Object.assign(mapp, { play });
})((window.mapp = window.mapp || {}));
