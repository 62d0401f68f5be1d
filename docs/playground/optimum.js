/*
 * The proven optimum of the cover time, as mapp_env.solve finds it: Held-Karp over every set of
 * landmarks, then the partition over the agents that is shortest in sum among the fastest.
 * A set is a number whose bit k stands for landmark k, in the order of the cells.
 */
"use strict";

(function (mapp) {
  const FAR = 1 << 29;

  /** Return the plan of smallest cover time, and of these one of the smallest total distance. */
  function solve(grid, landmarks, nAgents) {
    const cells = [...landmarks].sort((a, b) => a - b);
    const everything = (1 << cells.length) - 1;
    const routes = shortestRoutes(grid, cells);
    const ways = routes.map((ends, set) => (set ? Math.min(...ends) : 0));
    const teams = Math.min(nAgents, cells.length);
    const limit = leastSums(ways, teams, Math.max)[teams][everything];
    const home = cells.map((cell) => grid.distances[cell][grid.depot]);
    const tours = routes.map((ends, set) => {
      const closed = ends.map((steps, last) => (steps <= limit ? steps + home[last] : FAR));
      return set ? Math.min(...closed) : 0;
    });
    const parts = split(tours, teams);
    const orders = parts.map((set) => traceRoute(grid, cells, routes, home, limit, set));
    return walkOrders(grid, cells, nAgents, orders);
  }

  /** routes[S][k]: the steps of the shortest open path from the depot through S, ending on k. */
  function shortestRoutes(grid, cells) {
    const routes = [cells.map(() => FAR)];
    for (let set = 1; set < 1 << cells.length; set++) {
      routes.push(
        cells.map((cell, last) => {
          const before = set ^ (1 << last);
          if (before > set) return FAR;
          if (before === 0) return grid.distances[grid.depot][cell];
          return Math.min(
            FAR,
            ...cells.map((other, k) => routes[before][k] + grid.distances[other][cell]),
          );
        }),
      );
    }
    return routes;
  }

  /** The pairs (part, rest) of a set in which the part has the highest landmark, largest first. */
  function* partsOf(set) {
    const top = 1 << (31 - Math.clz32(set));
    const others = set ^ top;
    for (let part = others; ; part = (part - 1) & others) {
      yield [top | part, others ^ part];
      if (part === 0) return;
    }
  }

  /** least[n][S]: the least cost for n agents to visit S, costs joined by `join` (max or sum). */
  function leastSums(costs, teams, join) {
    const least = [costs.map((_, set) => (set ? FAR : 0))];
    for (let n = 1; n <= teams; n++) {
      least.push(
        costs.map((_, set) => {
          if (set === 0) return 0;
          let best = FAR;
          for (const [part, rest] of partsOf(set)) {
            best = Math.min(best, join(costs[part], least[n - 1][rest]));
          }
          return best;
        }),
      );
    }
    return least;
  }

  /** Return disjoint sets, one an agent, that hold everything with the least sum of tours. */
  function split(tours, teams) {
    const least = leastSums(tours, teams - 1, (a, b) => a + b);
    const chosen = [];
    let left = tours.length - 1;
    for (let n = teams - 1; n >= 0 && left; n--) {
      let [best, set] = [2 * FAR, left];
      for (const [part, rest] of partsOf(left)) {
        if (tours[part] + least[n][rest] < best) {
          best = tours[part] + least[n][rest];
          set = part;
        }
      }
      chosen.push(set);
      left ^= set;
    }
    return chosen;
  }

  /** Return the landmarks of a set's shortest tour whose last one is reached within the limit. */
  function traceRoute(grid, cells, routes, home, limit, set) {
    let [best, end] = [2 * FAR, -1];
    routes[set].forEach((steps, last) => {
      const tour = steps + home[last];
      const sooner = tour === best && steps < routes[set][end];
      if (steps <= limit && (tour < best || sooner)) [best, end] = [tour, last];
    });
    const order = [];
    while (set) {
      order.unshift(cells[end]);
      const steps = routes[set][end];
      set ^= 1 << end;
      const here = cells[end];
      end = cells.findIndex(
        (cell, k) => (set >> k) & 1 && routes[set][k] + grid.distances[cell][here] === steps,
      );
    }
    return order;
  }

  /** Let the agents walk through landmarks in the given orders, by the rules. */
  function walkOrders(grid, landmarks, nAgents, orders) {
    const tours = orders.map((order) => {
      const tour = [grid.depot];
      for (const cell of [...order, grid.depot]) {
        tour.push(...mapp.shortestPath(grid, tour[tour.length - 1], cell).slice(1));
      }
      return tour;
    });
    const command = (cells, _, step) =>
      cells.map((cell, agent) => {
        const tour = tours[agent] || [];
        return step + 1 < tour.length ? grid.moves[cell].indexOf(tour[step + 1]) : mapp.WAIT;
      });
    return mapp.play(grid, landmarks, nAgents, Infinity, command);
  }

  Object.assign(mapp, { solve });
})((window.mapp = window.mapp || {}));
