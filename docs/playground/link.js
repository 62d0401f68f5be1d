/* Links: the five landmarks of a problem in the address, as in index.html#0,6,20,42,48. */
"use strict";

(function (mapp) {
  const LONGEST = 60;

  /** Write landmarks as the part of an address that begins with #. */
  function toHash(landmarks) {
    return `#${[...landmarks].sort((a, b) => a - b).join(",")}`;
  }

  /** Read landmarks from an address: sorted cells, or an Error that says what is wrong. */
  function readHash(hash, grid, nLandmarks) {
    const text = hash.replace(/^#/, "").replace(/%2C/gi, ","); // as some messengers write it
    const shown = text.length > LONGEST ? `${text.slice(0, LONGEST)}…` : text;
    const words = text.split(",");
    if (text.length > LONGEST || !words.every((word) => /^\d{1,4}$/.test(word))) {
      throw new Error(`“${shown}” is not a list of cell numbers.`);
    }
    const cells = words.map(Number);
    if (cells.length !== nLandmarks) {
      throw new Error(`It names ${cells.length} cells, not ${nLandmarks}.`);
    }
    for (const cell of cells) {
      if (cell >= grid.nCells) {
        throw new Error(`Cell ${cell} is not on the grid, which ends at ${grid.nCells - 1}.`);
      }
      if (grid.walls[cell]) throw new Error(`Cell ${cell} is a wall.`);
      if (cell === grid.depot) throw new Error(`Cell ${cell} is the depot.`);
      if (!grid.reachable.includes(cell)) throw new Error(`No way leads to cell ${cell}.`);
    }
    if (new Set(cells).size !== cells.length) throw new Error("It names a cell twice.");
    return cells.sort((a, b) => a - b);
  }

  Object.assign(mapp, { toHash, readHash });
})((window.mapp = window.mapp || {}));
