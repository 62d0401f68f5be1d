/* What came out, in words and tables. */
"use strict";

(function (mapp) {
  const NUMBERS = ["no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine"];

  function inWords(number) {
    return NUMBERS[number] ?? String(number);
  }

  function count(number, noun) {
    return `${number} ${noun}${number === 1 ? "" : "s"}`;
  }

  /** Return the gap of a plan's cover time: (cost - optimum) / optimum. */
  function gapOf(plan, optimum) {
    return (plan.coverTime - optimum.coverTime) / optimum.coverTime;
  }

  function percent(share) {
    return `${(100 * share).toFixed(1).replace(/\.0$/, "")} %`;
  }

  /** Return what to say of two plans, and which kind of news it is. */
  function judge(network, optimum, flags) {
    const best = optimum.coverTime;
    if (!network.success) {
      const names = network.left.map((cell) => mapp.letter(flags.indexOf(cell))).join(" and ");
      const left = network.left.length === 1 ? `flag ${names} is` : `flags ${names} are`;
      const text = `Unsolved: at the limit of ${network.steps} steps ${left} left. The optimum takes ${best}.`;
      return { kind: "unsolved", text };
    }
    if (network.coverTime > best) {
      const gap = percent(gapOf(network, optimum));
      const text = `Gap ${gap}: the network takes ${network.coverTime} steps, the proven optimum ${best}.`;
      return { kind: "gap", text };
    }
    const all = `all ${inWords(flags.length)} flags in ${count(best, "step")}`;
    return { kind: "optimal", text: `Optimal: ${all}, and no plan is faster.` };
  }

  /** Fill in the table of costs; plans may be null. */
  function showCosts(table, network, optimum) {
    for (const row of table.querySelectorAll("[data-cost]")) {
      const name = row.dataset.cost;
      const cost = (plan) => (plan ? (plan.success ? String(plan[name]) : "unsolved") : "–");
      const [ours, best, gap] = row.querySelectorAll("td");
      ours.textContent = cost(network);
      best.textContent = cost(optimum);
      gap.textContent = "";
      if (name === "coverTime") {
        const known = network?.success && optimum;
        gap.textContent = known ? percent(gapOf(network, optimum)) : "–";
      }
    }
  }

  /** Fill in who claims which flag at which step. */
  function showClaims(table, nAgents, plans, flags) {
    const rows = [...Array(nAgents).keys()].map((agent) => {
      const row = document.createElement("tr");
      const head = document.createElement("th");
      head.scope = "row";
      head.className = `agent-${agent}`;
      const chip = document.createElement("span");
      chip.className = "chip";
      chip.textContent = agent;
      chip.setAttribute("aria-hidden", "true");
      head.append(chip, `agent ${agent}`);
      row.append(head, ...plans.map((plan) => claimsCell(plan?.claims[agent], flags)));
      return row;
    });
    table.querySelector("tbody").replaceChildren(...rows);
  }

  function claimsCell(claims, flags) {
    const cell = document.createElement("td");
    if (!claims?.length) cell.textContent = claims ? "nothing" : "–";
    for (const { landmark, step } of claims ?? []) {
      const claim = document.createElement("span");
      const name = document.createElement("b");
      name.textContent = mapp.letter(flags.indexOf(landmark));
      claim.className = "claim";
      claim.append(name, ` at ${step}`);
      cell.append(claim, " ");
    }
    return cell;
  }

  /** Return how far a plan is at a step: "3 of 5 flags". */
  function describeStep(plan, step, nFlags) {
    if (step === 0) return plan.success ? count(plan.coverTime, "step") : "unsolved";
    if (plan.success && step >= plan.coverTime) {
      return `all ${nFlags} flags at step ${plan.coverTime}`;
    }
    const visited = plan.claims.flat().filter((claim) => claim.step <= step).length;
    const ended = !plan.success && step >= plan.steps ? ", unsolved" : "";
    return `${visited} of ${nFlags} flags${ended}`;
  }

  /** Return the claims of a step in words. */
  function describeClaims(plan, step, flags) {
    return plan.claims.flatMap((claims, agent) =>
      claims
        .filter((claim) => claim.step === step)
        .map((claim) => `agent ${agent} visits ${mapp.letter(flags.indexOf(claim.landmark))}`),
    );
  }

  Object.assign(mapp, { judge, showCosts, showClaims, describeStep, describeClaims, inWords, count });
})((window.mapp = window.mapp || {}));
