/* The page: flags are put down, plans are made, time passes. */
"use strict";

(function (mapp) {
  const FIRST = [0, 6, 20, 42, 48]; // what is shown without a link
  const TRIES = 3000; // problems drawn to find one that the network misses
  const AT_ONCE = 20; // of them, before the page may do something else

  const $ = (id) => document.getElementById(id);
  const state = { flags: [], carried: null, step: 0, timer: null, search: null };
  let grid, spec, network, boards;

  // -- problems and plans ----------------------------------------------------------------------

  /** Return what the network does, and what is proven best, for landmarks in any order. */
  function plansOf(landmarks) {
    const cells = [...landmarks].sort((a, b) => a - b);
    const optimum = mapp.solve(grid, cells, spec.n_agents);
    const command = (at, visited) => network.act(at, cells, visited);
    const { max_cycles: limit } = mapp.policy;
    return { network: mapp.play(grid, cells, spec.n_agents, limit, command), optimum };
  }

  function draw(nLandmarks) {
    const left = [...grid.reachable];
    const take = () => left.splice(Math.floor(Math.random() * left.length), 1)[0];
    return Array.from({ length: nLandmarks }, take);
  }

  /** Show other flags; with all of them on the grid, make the plans. */
  function setFlags(flags, message = "") {
    pause();
    stopSearch();
    $("alert").hidden = true;
    state.flags = [...flags].sort((a, b) => a - b);
    state.carried = null;
    state.plans = state.flags.length === spec.n_landmarks ? plansOf(state.flags) : null;
    state.step = 0;
    const { network: ours = null, optimum = null } = state.plans ?? {};
    state.last = state.plans ? Math.max(lastStep(ours), lastStep(optimum)) : 0;
    mapp.showCosts($("costs"), ours, optimum);
    mapp.showClaims($("claims"), spec.n_agents, [ours, optimum], state.flags);
    showVerdict();
    setLink();
    say(message);
    refresh();
  }

  function lastStep(plan) {
    return plan.success ? plan.makespan : plan.steps;
  }

  function showVerdict() {
    const left = spec.n_landmarks - state.flags.length;
    const verdict = state.plans
      ? mapp.judge(state.plans.network, state.plans.optimum, state.flags)
      : { kind: "", text: `Put down ${mapp.inWords(left)} more flag${left === 1 ? "" : "s"}.` };
    $("verdict").textContent = verdict.text;
    $("verdict").dataset.kind = verdict.kind;
  }

  function setLink() {
    const hash = state.plans ? mapp.toHash(state.flags) : "";
    const address = location.href.split("#")[0] + hash;
    history.replaceState(null, "", hash || location.href.split("#")[0]);
    $("link").value = state.plans ? address : "";
    $("copy").disabled = !state.plans;
  }

  /** Show the flags of the address; of none, or of one that leads nowhere, others. */
  function followLink(others) {
    let [flags, error] = [others, null];
    try {
      if (location.hash.length > 1) flags = mapp.readHash(location.hash, grid, spec.n_landmarks);
    } catch (found) {
      error = found;
    }
    setFlags(flags);
    if (error === null) return;
    const asked = `A link names ${mapp.inWords(spec.n_landmarks)} different free cells, as in`;
    warn(`This link leads nowhere. ${error.message} ${asked} ${mapp.toHash(FIRST)}.`);
  }

  // -- hands on flags --------------------------------------------------------------------------

  function say(message) {
    $("message").textContent = message;
  }

  function warn(message) {
    $("alert").textContent = message;
    $("alert").hidden = false;
  }

  function isFree(cell) {
    if (grid.reachable.includes(cell)) return true;
    const what = cell === grid.depot ? "the depot" : "a wall";
    say(`A flag cannot stand on ${grid.walls[cell] || cell === grid.depot ? what : "this cell"}.`);
    return false;
  }

  function name(cell) {
    return `Flag ${mapp.letter(state.flags.indexOf(cell))}`;
  }

  /** Pick up, put down or put back, whatever a press of a cell means now. */
  function press(cell) {
    const { flags, carried } = state;
    if (cell === carried) return cancel();
    if (flags.includes(cell)) return pickUp(cell);
    if (!isFree(cell)) return undefined;
    if (carried !== null) return drag(carried, cell);
    if (flags.length < spec.n_landmarks) return setFlags([...flags, cell]);
    return say(`All ${mapp.inWords(flags.length)} flags are out: pick one up first.`);
  }

  function pickUp(cell) {
    if (!state.flags.includes(cell)) return; // taken away since it was pressed
    pause();
    stopSearch();
    state.carried = cell;
    say(`${name(cell)} is picked up: choose its new cell.`);
    refresh();
  }

  function cancel() {
    if (state.carried === null) return;
    say(`${name(state.carried)} is back in its place.`);
    state.carried = null;
    refresh();
  }

  function drag(from, to) {
    if (state.flags.includes(to)) return say("There is a flag already.");
    if (!isFree(to)) return undefined;
    const others = state.flags.filter((cell) => cell !== from);
    return setFlags([...others, to], "");
  }

  /** Put a dragged flag where it was released, or back; not one put back or away meanwhile. */
  function drop(from, to) {
    if (state.carried !== from) return;
    drag(from, to);
    if (state.carried === null) return;
    state.carried = null;
    refresh();
  }

  function remove(cell) {
    if (!state.flags.includes(cell)) return;
    setFlags(state.flags.filter((other) => other !== cell), `${name(cell)} is taken away.`);
  }

  // -- a problem that the network misses -------------------------------------------------------

  function findMiss() {
    pause();
    stopSearch();
    let tried = 0;
    $("message").setAttribute("aria-live", "off"); // nobody wants each count read out
    const search = () => {
      for (let i = 0; i < AT_ONCE; i++) {
        const flags = draw(spec.n_landmarks);
        const { network: ours, optimum } = plansOf(flags);
        tried += 1;
        if (ours.coverTime > optimum.coverTime) {
          return setFlags(flags, `Found after ${mapp.count(tried, "problem")}.`);
        }
      }
      if (tried >= TRIES) {
        stopSearch();
        return say(`Optimal on all ${tried} problems that were drawn. Try again?`);
      }
      say(`Optimal on ${tried} problems so far …`);
      state.search = setTimeout(search, 0);
      return undefined;
    };
    search();
  }

  function stopSearch() {
    clearTimeout(state.search);
    state.search = null;
    $("message").setAttribute("aria-live", "polite");
  }

  // -- time ------------------------------------------------------------------------------------

  /** Show everything anew: flags, plans, and where the agents are. */
  function refresh() {
    const { flags, carried, plans } = state;
    for (const [name, board] of Object.entries(boards)) {
      board.show(flags, carried, plans ? plans[name] : null);
    }
    showStep();
  }

  function goTo(step, glide = false) {
    state.step = Math.min(Math.max(step, 0), state.last);
    const speed = Number($("speed").value);
    document.documentElement.style.setProperty("--tick", glide ? `${0.85 * speed}ms` : "0ms");
    showStep();
  }

  function showStep() {
    const { plans, step, last, flags, timer } = state;
    for (const [name, board] of Object.entries(boards)) {
      board.setStep(step);
      $(`${name}-note`).textContent = plans
        ? mapp.describeStep(plans[name], step, flags.length)
        : "";
    }
    $("time").max = last || 1;
    $("time").value = step;
    const shown = plans ? `Step ${step} of ${last}` : "";
    $("time").setAttribute("aria-valuetext", shown);
    // While time runs, nobody wants each step read out.
    $("now").setAttribute("aria-live", timer ? "off" : "polite");
    $("now").textContent = plans ? [shown, ...news(plans, step, flags)].join(" · ") : "";
    for (const id of ["play", "time"]) $(id).disabled = !plans;
    for (const id of ["start", "back"]) disable($(id), !plans || step === 0);
    disable($("step"), !plans || step === last);
    document.querySelector(".player").classList.toggle("playing", timer !== null);
    document.querySelector("#play span").textContent = timer === null ? "Play" : "Pause";
  }

  /** Disable a button or not; the keyboard is not left without a place. */
  function disable(button, disabled) {
    if (disabled && button === document.activeElement) $("play").focus();
    button.disabled = disabled;
  }

  function news(plans, step, flags) {
    return Object.entries(plans).flatMap(([name, plan]) => {
      const claims = mapp.describeClaims(plan, step, flags);
      return claims.length ? [`${name}: ${claims.join(", ")}`] : [];
    });
  }

  function tick() {
    if (state.step >= state.last) return pause();
    state.timer = setTimeout(tick, Number($("speed").value));
    return goTo(state.step + 1, true);
  }

  function play() {
    if (state.timer !== null) return pause();
    if (state.carried !== null) cancel();
    say("");
    if (state.step >= state.last) goTo(0);
    return tick();
  }

  function pause() {
    if (state.timer === null) return;
    clearTimeout(state.timer);
    state.timer = null;
    showStep();
  }

  function jump(step, glide) {
    pause();
    if (state.carried !== null) cancel();
    say("");
    goTo(step, glide);
  }

  // -- setting up ------------------------------------------------------------------------------

  async function copy() {
    const field = $("link");
    field.select();
    try {
      await navigator.clipboard.writeText(field.value);
    } catch {
      if (!document.execCommand("copy")) return say("Select the link and copy it by hand.");
    }
    return say("The link is copied.");
  }

  function connect() {
    const on = (id, event, handler) => $(id).addEventListener(event, handler);
    on("random", "click", () => setFlags(draw(spec.n_landmarks)));
    on("miss", "click", findMiss);
    on("clear", "click", () => setFlags([]));
    on("start", "click", () => jump(0));
    on("back", "click", () => jump(state.step - 1, true));
    on("step", "click", () => jump(state.step + 1, true));
    on("play", "click", play);
    on("time", "input", () => jump(Number($("time").value)));
    on("views", "change", (event) => ($("boards").dataset.view = event.target.value));
    on("copy", "click", copy);
    window.addEventListener("hashchange", () => followLink(state.flags));
  }

  function aboutNetwork() {
    const numbers = Object.values(mapp.policy.tensors).map(({ shape }) =>
      shape.reduce((product, size) => product * size, 1),
    );
    const total = numbers.reduce((sum, number) => sum + number, 0);
    const { name, sha256 } = mapp.policy;
    return `The network is the policy “${name}” of this repository (SHA-256 ${sha256.slice(0, 12)}…), its weights rounded to 16 bits, ${total.toLocaleString("en")} of them here. At each step it is given the cells of agents and flags, and the joint action that it values most is taken: no search, no heuristics.`;
  }

  function start() {
    try {
      if (!mapp.policy) throw new Error("weights.js is missing or damaged.");
      ({ spec } = mapp.policy);
      grid = mapp.makeGrid(mapp.policy.grid);
      network = new mapp.Network(mapp.policy, grid);
    } catch (error) {
      warn(`The network cannot be read: ${error.message} Its file is made by baselines/export_playground.py.`);
      for (const control of document.querySelectorAll("button, input, select")) control.disabled = true;
      return;
    }
    const handlers = { press, pickUp, drop, remove, cancel };
    boards = Object.fromEntries(
      ["network", "optimum"].map((name) => [name, new mapp.Board($(`${name}-board`), grid, handlers)]),
    );
    $("about-network").textContent = aboutNetwork();
    if (location.protocol === "file:") $("link-note").textContent = ", for this machine: the page is opened as a file";
    connect();
    followLink(FIRST);
    Object.assign(mapp, { grid, plansOf, network });
  }

  start();
})((window.mapp = window.mapp || {}));
