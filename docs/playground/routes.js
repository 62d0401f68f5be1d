/*
 * Lines of routes: they keep to the right of the corridor's middle, as traffic does, and routes that
 * make the same move run side by side, as in mapp_env/rendering/routes.py.
 */
"use strict";

(function (mapp) {
  const LANE = 0.12; // cells from one lane to the next

  /** Return the walk's cells without pauses, and at each step how many moves were made. */
  function withoutPauses(walk) {
    const tour = [walk.cells[0]];
    const moved = [0];
    for (let step = 1; step < walk.cells.length; step++) {
      if (walk.cells[step] !== walk.cells[step - 1]) tour.push(walk.cells[step]);
      moved.push(tour.length - 1);
    }
    return { tour, moved };
  }

  /** Return a lane for each tour, such that no two on one lane make the same move. */
  function findLanes(tours) {
    const taken = [];
    return tours.map((tour) => {
      const moves = tour.slice(1).map((cell, index) => `${tour[index]}-${cell}`);
      let lane = taken.findIndex((others) => !moves.some((move) => others.has(move)));
      if (lane < 0) lane = taken.push(new Set()) - 1;
      moves.forEach((move) => taken[lane].add(move));
      return lane;
    });
  }

  /**
   * Return a tour as a line: its corners [across, down], in cells, and for each of the tour's cells
   * the corner from which the line leaves it.
   */
  function keepRight(tour, cols, offset) {
    const middles = tour.map((cell) => [(cell % cols) + 0.5, Math.floor(cell / cols) + 0.5]);
    const headings = middles.slice(1).map(([x, y], i) => [x - middles[i][0], y - middles[i][1]]);
    const corners = [];
    const leaves = [];
    middles.forEach(([x, y], i) => {
      const into = headings[Math.max(i - 1, 0)];
      const out = headings[Math.min(i, headings.length - 1)];
      const to = (right) => corners.push([x + offset * right[0], y + offset * right[1]]);
      if (into[0] === -out[0] && into[1] === -out[1]) {
        to([into[0] - into[1], into[1] + into[0]]); // around the end of the middle line
        to([into[0] - out[1], into[1] + out[0]]);
      } else if (into[0] === out[0] && into[1] === out[1]) {
        to([-into[1], into[0]]);
      } else {
        to([-into[1] - out[1], into[0] + out[0]]);
      }
      leaves.push(corners.length - 1);
    });
    return { corners, leaves };
  }

  /** Return the lines of a plan's walks, null for an agent that stays where it is. */
  function drawLines(plan, cols) {
    const walks = plan.walks.map((walk) => ({ ...withoutPauses(walk), end: walk.end }));
    const lanes = findLanes(walks.map(({ tour }) => tour));
    return walks.map(({ tour, moved, end }, agent) => {
      if (tour.length < 2) return null;
      const { corners, leaves } = keepRight(tour, cols, (lanes[agent] + 0.5) * LANE);
      const lengths = [0]; // of the line, up to each corner
      corners.slice(1).forEach(([x, y], i) => {
        lengths.push(lengths[i] + Math.hypot(x - corners[i][0], y - corners[i][1]));
      });
      const turn = moved[end]; // moves up to the last claim
      return { tour, corners, leaves, lengths, moved, turn, lane: lanes[agent] };
    });
  }

  Object.assign(mapp, { drawLines });
})((window.mapp = window.mapp || {}));
