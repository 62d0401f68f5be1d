/* A grid: text to walls, moves and distances, as mapp_env/grid.py has them. */
"use strict";

(function (mapp) {
  const WALLS = "#@TO";
  const WAIT = 4;

  /** Parse a grid's text. Cells are row-major; actions 0 left, 1 right, 2 up, 3 down, 4 wait. */
  function makeGrid(text) {
    const lines = text.trim().split("\n");
    const [rows, cols] = [lines.length, lines[0].length];
    const letters = [...lines.join("")];
    const walls = letters.map((letter) => WALLS.includes(letter));
    const depot = letters.indexOf("D");
    const moves = letters.map((_, cell) => movesFrom(cell, rows, cols, walls));
    const distances = letters.map((_, cell) => distancesFrom(cell, moves));
    const reachable = [...letters.keys()].filter((c) => c !== depot && distances[depot][c] > 0);
    return { rows, cols, nCells: letters.length, walls, depot, moves, distances, reachable };
  }

  /** Return the next cell for each action: a bump leaves an agent where it is. */
  function movesFrom(cell, rows, cols, walls) {
    const [row, col] = [Math.floor(cell / cols), cell % cols];
    const steps = [[0, -1], [0, 1], [-1, 0], [1, 0]];
    const next = steps.map(([down, across]) => {
      const [r, c] = [row + down, col + across];
      const inside = r >= 0 && r < rows && c >= 0 && c < cols;
      return inside && !walls[cell] && !walls[r * cols + c] ? r * cols + c : cell;
    });
    next[WAIT] = cell;
    return next;
  }

  /** Return the steps from a cell to every cell, -1 where there is no way (breadth first). */
  function distancesFrom(start, moves) {
    const steps = new Array(moves.length).fill(-1);
    steps[start] = 0;
    const queue = [start];
    for (const cell of queue) {
      for (const next of moves[cell]) {
        if (steps[next] < 0) {
          steps[next] = steps[cell] + 1;
          queue.push(next);
        }
      }
    }
    return steps;
  }

  /** Return a shortest path, both ends included; among equals the first in action order. */
  function shortestPath(grid, start, end) {
    const left = grid.distances[end];
    const path = [start];
    while (path[path.length - 1] !== end) {
      const cell = path[path.length - 1];
      path.push(grid.moves[cell].find((next) => left[next] === left[cell] - 1));
    }
    return path;
  }

  Object.assign(mapp, { makeGrid, shortestPath, WAIT });
})((window.mapp = window.mapp || {}));
