/*
 * The network "pairs" of baselines/networks/__init__.py, in 32-bit arithmetic, from the 16-bit weights in
 * weights.js. Arrays of numbers are Float32Array throughout: what is stored there is rounded.
 */
"use strict";

(function (mapp) {
  // -- weights -------------------------------------------------------------------------------

  let halves = null; // what each of the 65,536 16-bit patterns stands for

  function halfValues() {
    const values = new Float32Array(65536);
    for (let bits = 0; bits < values.length; bits++) {
      const [exponent, fraction] = [(bits >> 10) & 31, bits & 1023];
      let size = 2 ** (exponent - 25) * (1024 + fraction);
      if (exponent === 0) size = 2 ** -24 * fraction;
      if (exponent === 31) size = NaN;
      values[bits] = bits >> 15 ? -size : size;
    }
    return values;
  }

  /** Return the numbers of one tensor: base64 of little-endian 16-bit floats. */
  function decode(name, { shape, data }) {
    halves = halves || halfValues();
    const bytes = atob(data);
    const values = new Float32Array(shape.reduce((product, size) => product * size, 1));
    if (bytes.length !== 2 * values.length) throw new Error(`${name} has another length.`);
    for (let i = 0; i < values.length; i++) {
      values[i] = halves[bytes.charCodeAt(2 * i) | (bytes.charCodeAt(2 * i + 1) << 8)];
    }
    if (values.some(Number.isNaN)) throw new Error(`${name} holds what is no number.`);
    return values;
  }

  /**
   * Return which rows of the big tables are in the file, in its order: those that an episode can
   * look up. Landmarks are free cells but the depot, agents stand on these and on the depot, and
   * never on an unvisited landmark. baselines/export_playground.py lists them in the same way.
   */
  function keptRows(spec, grid) {
    const [c, visited] = [spec.n_cells, spec.n_cells];
    const landmarks = grid.reachable;
    const cells = [...landmarks, grid.depot].sort((a, b) => a - b);
    const pairs = cells.flatMap((cell) =>
      [...landmarks.filter((l) => l !== cell), visited].map((place) => cell * (c + 2) + place),
    );
    const alone = cells.map((cell) => cell * (c + 2) + c + 1);
    const places = [...landmarks, visited];
    const agents = [...Array(spec.n_agents).keys()];
    return {
      pairs: [...pairs, ...alone],
      unvisited: places,
      crossed: agents.flatMap((slot) => pairs.map((row) => slot * c * (c + 2) + row)),
      between: places.flatMap((one) => places.map((other) => one * (c + 1) + other)),
      routes: [...keptRoutes(cells, landmarks, c), (c * c * (c - 1)) / 2],
    };
  }

  function keptRoutes(cells, landmarks, c) {
    const rows = [];
    for (const cell of cells) {
      for (const high of landmarks) {
        for (const low of landmarks) {
          if (low >= high || low === cell || high === cell) continue;
          rows.push(cell * ((c * (c - 1)) / 2) + (high * (high - 1)) / 2 + low);
        }
      }
    }
    return rows;
  }

  /** A table of vectors that are looked up by their row in the full table, and summed. */
  class Bag {
    constructor(name, values, nUnits, rows) {
      if (values.length !== rows.length * nUnits) throw new Error(`${name} has other rows.`);
      this.values = values;
      this.nUnits = nUnits;
      this.places = new Map(rows.map((row, place) => [row, place * nUnits]));
    }

    sum(rows) {
      const total = new Float32Array(this.nUnits);
      for (const row of rows) {
        const start = this.places.get(row);
        for (let unit = 0; unit < total.length; unit++) total[unit] += this.values[start + unit];
      }
      return total;
    }
  }

  /** A linear layer; the weights are kept input by input, as many inputs are 0. */
  class Linear {
    constructor(name, weight, bias, nIn) {
      const nOut = bias.length;
      if (weight.length !== nIn * nOut) throw new Error(`${name} has another size.`);
      this.bias = bias;
      this.columns = Array.from({ length: nIn }, (_, from) =>
        Float32Array.from(bias, (_, to) => weight[to * nIn + from]),
      );
    }

    apply(inputs) {
      const out = new Float32Array(this.bias.length);
      inputs.forEach((input, from) => {
        if (input === 0) return;
        const column = this.columns[from];
        for (let to = 0; to < out.length; to++) out[to] += column[to] * input;
      });
      return add(out, this.bias);
    }
  }

  function add(numbers, others) {
    for (let i = 0; i < numbers.length; i++) numbers[i] += others[i];
    return numbers;
  }

  function rectify(numbers) {
    for (let i = 0; i < numbers.length; i++) numbers[i] = Math.max(numbers[i], 0);
    return numbers;
  }

  // -- the network ---------------------------------------------------------------------------

  class Network {
    /** Build the network of what weights.js holds; an Error says what is wrong with it. */
    constructor(policy, grid) {
      const spec = (this.spec = policy.spec);
      if (spec.kind !== "pairs" || spec.outputs !== "joint" || spec.team !== "one") {
        throw new Error(`A network of kind ${spec.kind} cannot be run here.`);
      }
      const values = Object.fromEntries(
        Object.entries(policy.tensors).map(([name, tensor]) => [name, decode(name, tensor)]),
      );
      const rows = keptRows(spec, grid);
      const bag = (name, units) => new Bag(name, values[`${name}.weight`], units, rows[name]);
      const linear = (name, nIn) =>
        new Linear(name, values[`${name}.weight`], values[`${name}.bias`], nIn);
      const agentUnits = spec.code_units + spec.route_units;
      const among = spec.landmark_units;
      this.pairs = bag("pairs", agentUnits);
      this.unvisited = bag("unvisited", spec.hidden_units);
      this.crossed = among ? bag("crossed", among) : null;
      this.routes = spec.route_units ? bag("routes", spec.route_units) : null;
      this.between = spec.route_units && among ? bag("between", among) : null;
      this.hidden = linear("hidden", spec.n_agents * agentUnits + among);
      this.advantages = linear("head.advantages", spec.hidden_units);
      this.value = spec.dueling ? linear("head.value", spec.hidden_units) : null;
      this.digits = jointActions(spec.n_agents, spec.n_actions);
    }

    /** Return the greedy joint action: of equal values the first. */
    act(cells, landmarks, visited) {
      const values = this.values(cells, landmarks, visited);
      let best = 0;
      for (let i = 1; i < values.length; i++) if (values[i] > values[best]) best = i;
      return this.digits[best];
    }

    /** Return the values of the joint actions; the first agent's action is most significant. */
    values(cells, landmarks, visited) {
      const spec = this.spec;
      // Visited landmarks share a place; agents come in the order of their cells.
      const seen = landmarks.map((cell, index) => (visited[index] ? spec.n_cells : cell));
      const order = [...cells.keys()].sort((a, b) => cells[a] - cells[b]);
      const codes = this.codes(order.map((agent) => cells[agent]), seen);
      const hidden = rectify(add(this.hidden.apply(codes), this.unvisited.sum(seen)));
      const sorted = this.score(hidden);
      return Float32Array.from(this.digits, (own) => {
        return sorted[order.reduce((row, agent) => row * spec.n_actions + own[agent], 0)];
      });
    }

    /** Return what describes agents (in the order given) and landmarks. */
    codes(cells, seen) {
      const { spec } = this;
      const nPlaces = spec.n_cells + 2;
      const agents = cells.map((cell) => {
        const pairs = [...seen, spec.n_cells + 1].map((place) => cell * nPlaces + place);
        const code = this.pairs.sum(pairs);
        if (this.routes) {
          const ways = this.routes.sum(routesThrough(cell, seen, spec.n_cells));
          add(code.subarray(spec.code_units), ways);
        }
        return rectify(code);
      });
      const all = agents.flatMap((code) => [...code]);
      return Float32Array.from(this.crossed ? [...all, ...this.crossCodes(cells, seen)] : all);
    }

    /** Return the sum of what describes each landmark among the agents, and the landmarks. */
    crossCodes(cells, seen) {
      const nPlaces = this.spec.n_cells + 2;
      const total = new Float32Array(this.spec.landmark_units);
      for (const place of seen) {
        const slots = cells.map((cell, slot) => (slot * (nPlaces - 2) + cell) * nPlaces + place);
        const code = this.crossed.sum(slots);
        if (this.between) {
          add(code, this.between.sum(seen.map((other) => place * (nPlaces - 1) + other)));
        }
        add(total, rectify(code));
      }
      return total;
    }

    /** Return the values of the sorted agents' joint actions, of the hidden units. */
    score(hidden) {
      const scores = this.advantages.apply(hidden);
      if (!this.value) return scores;
      const base = this.value.apply(hidden)[0];
      const sum = scores.reduce((total, score) => Math.fround(total + score), 0);
      const mean = Math.fround(sum / scores.length);
      return scores.map((score) => Math.fround(base + score) - mean);
    }
  }

  /** Return the rows for an agent's cell with every two unvisited landmarks. */
  function routesThrough(cell, seen, c) {
    const nTwo = (c * (c - 1)) / 2;
    const rows = [];
    for (let one = 0; one < seen.length; one++) {
      for (let other = 0; other < one; other++) {
        const low = Math.min(seen[one], seen[other]);
        const high = Math.max(seen[one], seen[other]);
        const two = high < c ? cell * nTwo + (high * (high - 1)) / 2 + low : c * nTwo;
        rows.push(two);
      }
    }
    return rows.length ? rows : [c * nTwo];
  }

  /** Return all joint actions, the last agent's changing fastest. */
  function jointActions(nAgents, nActions) {
    let joint = [[]];
    for (let agent = 0; agent < nAgents; agent++) {
      joint = joint.flatMap((start) => [...Array(nActions).keys()].map((a) => [...start, a]));
    }
    return joint;
  }

  Object.assign(mapp, { Network });
})((window.mapp = window.mapp || {}));
