/* A board: a picture of grid, flags, routes and agents, under a grid of buttons. */
"use strict";

(function (mapp) {
  const SIDE = 100; // units of the picture to a cell
  // Where agents stand that share a cell, by how many they are.
  const SPREAD = [[], [[0, 0]], [[-23, 0], [23, 0]], [[-26, 22], [26, 22], [0, -26]]];

  /** Make an SVG element. */
  function svg(name, attributes = {}, ...children) {
    const element = document.createElementNS("http://www.w3.org/2000/svg", name);
    for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
    element.append(...children);
    return element;
  }

  function points(corners) {
    return `M${corners.map(([x, y]) => `${x * SIDE},${y * SIDE}`).join("L")}`;
  }

  class Board {
    /**
     * Fill an element. `handlers` has `press(cell)`, `pickUp(cell)`, `drop(from, to)`,
     * `remove(cell)` and `cancel()`.
     */
    constructor(element, grid, handlers) {
      Object.assign(this, { element, grid, handlers, flags: [], carried: null, plan: null });
      this.layers = Object.fromEntries(
        ["tints", "walls", "routes", "signs", "agents"].map((name) => [name, svg("g")]),
      );
      const { rows, cols } = grid;
      const size = `0 0 ${cols * SIDE} ${rows * SIDE}`;
      element.append(
        svg("svg", { viewBox: size, "aria-hidden": "true" }, ...Object.values(this.layers)),
      );
      this.drawGround();
      this.makeCells();
      this.moveCursor(grid.depot);
    }

    at(cell) {
      return [(cell % this.grid.cols) * SIDE, Math.floor(cell / this.grid.cols) * SIDE];
    }

    tile(cell, kind) {
      const [x, y] = this.at(cell);
      return svg("rect", { x, y, width: SIDE, height: SIDE, class: kind });
    }

    drawGround() {
      const { grid, layers } = this;
      const [right, bottom] = [grid.cols * SIDE, grid.rows * SIDE];
      for (let x = SIDE; x < right; x += SIDE) {
        layers.walls.append(svg("path", { d: `M${x},0V${bottom}`, class: "line" }));
      }
      for (let y = SIDE; y < bottom; y += SIDE) {
        layers.walls.append(svg("path", { d: `M0,${y}H${right}`, class: "line" }));
      }
      grid.walls.forEach((wall, cell) => {
        if (wall) layers.walls.append(this.tile(cell, "wall"));
      });
    }

    // -- buttons -----------------------------------------------------------------------------

    makeCells() {
      const { grid } = this;
      const cells = document.createElement("div");
      cells.className = "cells";
      cells.setAttribute("role", "grid");
      cells.setAttribute("aria-label", `${this.element.dataset.name}: the grid`);
      cells.style.gridTemplate = `repeat(${grid.rows}, 1fr) / repeat(${grid.cols}, 1fr)`;
      this.buttons = [];
      for (let row = 0; row < grid.rows; row++) {
        const line = document.createElement("div");
        line.setAttribute("role", "row");
        for (let col = 0; col < grid.cols; col++) {
          const button = document.createElement("button");
          button.type = "button";
          button.setAttribute("role", "gridcell");
          button.dataset.cell = this.buttons.length;
          button.tabIndex = -1;
          this.buttons.push(button);
          line.append(button);
        }
        cells.append(line);
      }
      cells.addEventListener("click", (event) => this.onClick(event));
      cells.addEventListener("keydown", (event) => this.onKey(event));
      cells.addEventListener("focusin", (event) => this.moveCursor(this.cellOf(event.target)));
      cells.addEventListener("pointerdown", (event) => this.onGrab(event));
      this.element.append(cells);
    }

    cellOf(target) {
      const button = target instanceof Element ? target.closest("[data-cell]") : null;
      return button && this.element.contains(button) ? Number(button.dataset.cell) : null;
    }

    moveCursor(cell) {
      if (this.cursor !== undefined) this.buttons[this.cursor].tabIndex = -1;
      this.cursor = cell;
      this.buttons[cell].tabIndex = 0;
    }

    onClick(event) {
      const cell = this.cellOf(event.target);
      if (cell === null || this.dropped) return;
      this.moveCursor(cell);
      this.handlers.press(cell);
    }

    onKey(event) {
      const { rows, cols } = this.grid;
      const [row, col] = [Math.floor(this.cursor / cols), this.cursor % cols];
      const to = {
        ArrowLeft: [row, Math.max(col - 1, 0)],
        ArrowRight: [row, Math.min(col + 1, cols - 1)],
        ArrowUp: [Math.max(row - 1, 0), col],
        ArrowDown: [Math.min(row + 1, rows - 1), col],
        Home: [row, 0],
        End: [row, cols - 1],
      }[event.key];
      if (event.ctrlKey || event.altKey || event.metaKey) return;
      if (to) {
        this.moveCursor(to[0] * cols + to[1]);
        this.buttons[this.cursor].focus();
      } else if (event.key === "Escape") {
        this.handlers.cancel();
      } else if (event.key === "Delete" || event.key === "Backspace") {
        this.handlers.remove(this.cursor);
      } else {
        return;
      }
      event.preventDefault();
    }

    /** Drag a flag: it is carried once it leaves its cell, and put where it is released. */
    onGrab(event) {
      const from = this.cellOf(event.target);
      if (from === null || !this.flags.includes(from)) return;
      if (event.button !== 0 || !event.isPrimary) return; // menus are no drags
      const finger = event.pointerId;
      let lifted = false;
      const under = ({ clientX, clientY }) => this.cellOf(document.elementFromPoint(clientX, clientY));
      const move = (event) => {
        if (lifted || event.pointerId !== finger || under(event) === from) return;
        lifted = true;
        this.handlers.pickUp(from);
      };
      const release = (event) => {
        if (event.pointerId !== finger) return;
        window.removeEventListener("pointermove", move);
        for (const end of ["pointerup", "pointercancel"]) window.removeEventListener(end, release);
        const to = event.type === "pointerup" ? under(event) : null;
        if (!lifted && (to === null || to === from)) return;
        this.dropped = true; // some browsers send a click after it
        setTimeout(() => (this.dropped = false), 0);
        if (to === null || to === from) return this.handlers.cancel();
        if (!lifted) this.handlers.pickUp(from); // released before it was seen to move
        this.handlers.drop(from, to);
      };
      window.addEventListener("pointermove", move);
      for (const end of ["pointerup", "pointercancel"]) window.addEventListener(end, release);
    }

    // -- what is shown -----------------------------------------------------------------------

    /** Show flags (sorted cells), of which one may be carried, and a plan, if there is one. */
    show(flags, carried, plan) {
      Object.assign(this, { flags, carried, plan });
      const { tints, signs, routes, agents } = this.layers;
      tints.replaceChildren(this.tile(this.grid.depot, "depot-cell"));
      signs.replaceChildren(this.house());
      this.marks = flags.map((cell, index) => {
        const tint = svg("g", {}, this.tile(cell, "flag-cell"));
        const sign = this.flag(cell, mapp.letter(index));
        tints.append(tint);
        signs.append(sign);
        return [tint, sign];
      });
      this.lines = plan ? mapp.drawLines(plan, this.grid.cols) : [];
      this.drawn = this.lines.map((line, agent) => (line ? drawRoute(line, agent) : null));
      routes.replaceChildren(...this.drawn.filter(Boolean).map(({ group }) => group));
      this.discs = plan ? plan.walks.map((_, agent) => disc(agent)) : [];
      agents.replaceChildren(...this.discs);
      this.setStep(0);
    }

    /** Show where everything is after so many steps; at 0 the routes are shown whole. */
    setStep(step) {
      const { plan } = this;
      const owners = new Map(); // of the flags visited by now
      plan?.claims.forEach((claims, agent) =>
        claims.forEach((claim) => claim.step <= step && owners.set(claim.landmark, agent)),
      );
      this.flags.forEach((cell, index) => {
        const kind = `flag${owners.has(cell) ? " visited" : ""}`;
        const carried = cell === this.carried ? " carried" : "";
        this.marks[index].forEach((mark) => mark.setAttribute("class", kind + carried));
      });
      this.drawn.forEach((route, agent) => {
        if (route) showProgress(route, this.lines[agent], step);
      });
      this.placeAgents(step);
      this.labelCells(owners);
    }

    placeAgents(step) {
      const cells = (this.plan?.walks ?? []).map((walk) => walk.cells[Math.min(step, walk.cells.length - 1)]);
      cells.forEach((cell, agent) => {
        const [x, y] = this.at(cell);
        const sharing = [...cells.keys()].filter((other) => cells[other] === cell);
        const [dx, dy] = SPREAD[sharing.length]?.[sharing.indexOf(agent)] ?? [0, 0];
        this.discs[agent].style.transform = `translate(${x + 50 + dx}px, ${y + 50 + dy}px)`;
      });
    }

    labelCells(owners) {
      const { grid, flags, carried } = this;
      this.buttons.forEach((button, cell) => {
        const place = `row ${Math.floor(cell / grid.cols) + 1}, column ${(cell % grid.cols) + 1}`;
        const index = flags.indexOf(cell);
        let what = "free";
        if (grid.walls[cell]) what = "wall";
        if (cell === grid.depot) what = "depot";
        if (index >= 0) what = `flag ${mapp.letter(index)}`;
        if (index >= 0 && cell === carried) what += ", picked up";
        if (owners.has(cell)) what += `, visited by agent ${owners.get(cell)}`;
        button.setAttribute("aria-label", `${place}: ${what}`);
        const blocked = !grid.reachable.includes(cell);
        button.setAttribute("aria-disabled", String(blocked));
        button.className = blocked ? "" : index >= 0 ? "free held" : "free";
      });
    }

    house() {
      const [x, y] = this.at(this.grid.depot);
      return svg(
        "g",
        { transform: `translate(${x}, ${y})` },
        svg("path", { d: "M8,50L50,12L92,50H80V86H20V50Z", class: "depot" }),
        svg("rect", { x: 42, y: 60, width: 16, height: 26, class: "depot-door" }),
      );
    }

    flag(cell, letter) {
      const [x, y] = this.at(cell);
      const cloth = "M30,9L88,32L30,55Z";
      const check = "M50,74L62,86L86,58";
      const name = svg("text", { x: 46, y: 40 });
      name.textContent = letter;
      return svg(
        "g",
        { transform: `translate(${x}, ${y})` },
        svg("path", { d: `${cloth}M30,9V88`, class: "halo" }),
        svg("ellipse", { cx: 30, cy: 87, rx: 13, ry: 5, class: "foot" }),
        svg("path", { d: cloth, class: "cloth" }),
        svg("path", { d: "M30,7V87", class: "pole" }),
        svg("path", { d: check, class: "check-halo" }),
        svg("path", { d: check, class: "check" }),
        name,
      );
    }
  }

  // -- routes and agents -----------------------------------------------------------------------

  function disc(agent) {
    const number = svg("text", { y: 1 });
    number.textContent = agent;
    return svg("g", { class: `agent agent-${agent}` }, svg("circle", { r: 20 }), number);
  }

  /** Draw a route: faint as a whole, and above it what is walked by now. */
  function drawRoute(line, agent) {
    const { corners, leaves, lengths, turn } = line;
    const cut = leaves[turn];
    const out = points(corners.slice(0, cut + 1));
    const home = points(corners.slice(cut));
    const length = lengths[cut] * SIDE;
    const walked = svg("path", { d: out, class: "route out walked" });
    walked.style.strokeDasharray = `${length} ${length + 100}`;
    const homeward = svg("path", { d: home, class: "route home" });
    const arrows = leaves.slice(0, -1).map((_, move) => drawArrow(line, move));
    const group = svg(
      "g",
      { class: `agent-${agent}` },
      svg("path", { d: out, class: "route out faint" }),
      homeward,
      walked,
      ...arrows,
    );
    return { group, walked, homeward, arrows, cut, length };
  }

  /** Draw an arrow on a move: before its middle on one lane, beyond it on the next. */
  function drawArrow({ corners, leaves, turn, lane }, move) {
    const [x, y] = corners[leaves[move]];
    const [endX, endY] = corners[leaves[move] + 1];
    const share = lane % 2 ? 0.36 : 0.64;
    const turned = (Math.atan2(endY - y, endX - x) * 180) / Math.PI;
    const [atX, atY] = [x + share * (endX - x), y + share * (endY - y)];
    return svg("path", {
      d: "M-8,-9L9,0L-8,9Z",
      transform: `translate(${atX * SIDE}, ${atY * SIDE}) rotate(${turned})`,
      class: move >= turn ? "arrow home" : "arrow",
    });
  }

  function showProgress({ walked, homeward, arrows, cut, length }, line, step) {
    const whole = step === 0;
    const moves = line.moved[Math.min(step, line.moved.length - 1)];
    const along = line.lengths[Math.min(line.leaves[moves], cut)] * SIDE;
    walked.style.strokeDashoffset = whole ? 0 : length - along;
    homeward.classList.toggle("faint", !whole && moves <= line.turn);
    arrows.forEach((arrow, move) => arrow.classList.toggle("faint", !whole && move >= moves));
  }

  /** Return what the flag of an index is called. */
  function letter(index) {
    return String.fromCharCode(65 + index);
  }

  Object.assign(mapp, { Board, letter });
})((window.mapp = window.mapp || {}));
