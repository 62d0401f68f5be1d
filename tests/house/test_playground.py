"""The page in docs/playground, in a browser without a window: it acts and counts as Python does.

Where there is no Chromium these tests are skipped, as the fixture ``browser`` says.
"""

from __future__ import annotations

import itertools
import json
import os
import shutil
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from playwright.sync_api import Browser, Page

from baselines.export_playground import PLAYGROUND, export
from baselines.networks import build_network, network_spec, torch_generator
from baselines.policies.evaluation import evaluate
from baselines.policies.policy import PRETRAINED, load_policy, save_policy
from baselines.policies.settings import Setting
from mapp_env import Plan, Problem, make_grid, replay, sample_problems, solve

GRID = make_grid()
SETTING = Setting(GRID)
FIRST = [0, 6, 20, 42, 48]  # what the page shows without a link
COSTS = ("cover_time", "makespan", "total_distance")

# More, for a longer check of the page against the weights that it has: those rounded to 16 bits.
N_ROUNDED = int(os.environ.get("MAPP_PLAYGROUND_PROBLEMS", "200"))

# Plans of many problems, as plain lists; an infinite cost is null.
PLAY = """problems => problems.map(landmarks => Object.fromEntries(
    Object.entries(mapp.plansOf(landmarks)).map(([name, plan]) => [name, {
        actions: plan.actions, cover_time: plan.coverTime, makespan: plan.makespan,
        total_distance: plan.totalDistance, success: plan.success,
        claims: plan.claims.map(own => own.map(claim => claim.landmark)),
    }])))"""
# The joint actions' values on observations (cells, landmarks, visited flags).
VALUES = """rows => rows.map(([cells, landmarks, visited]) =>
    Array.from(mapp.network.values(cells, landmarks, visited.map(Boolean))))"""


@pytest.fixture
def visit(browser: Browser) -> Iterator[Callable[..., Page]]:
    """Open the page as a file; at the end nothing went wrong and nothing came from elsewhere."""
    asked: list[str] = []
    wrong: list[str] = []
    contexts = []

    def open_page(hash_: str = "", folder: Path = PLAYGROUND, **options: Any) -> Page:
        context = browser.new_context(**options)
        contexts.append(context)
        page = context.new_page()
        page.set_default_timeout(300_000)  # for slow machines
        page.on("request", lambda request: asked.append(request.url))
        page.on("console", lambda message: wrong.append(message.text))
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.goto((folder / "index.html").as_uri() + hash_)
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert wrong == []
    assert [url for url in asked if not url.startswith(("file:", "data:"))] == []
    assert any(url.endswith("weights.js") for url in asked)


@cache
def problems(n: int = 200) -> np.ndarray:
    """Return the same problems for every policy."""
    return sample_problems(GRID, n, n_landmarks=5, seed=11)


def page_with(script: str, folder: Path) -> Path:
    """Copy the page to a folder, with another script of weights."""
    shutil.copytree(PLAYGROUND, folder)
    (folder / "weights.js").write_text(script, encoding="utf-8")
    return folder


def greedy_plans(policy: str | Path, landmarks: np.ndarray) -> list[Plan]:
    """Return what the rules make of a policy's greedy episodes in Python."""
    played = evaluate(load_policy(policy), SETTING, landmarks, n_kept=len(landmarks))
    return [
        replay(Problem(GRID, row), played.actions[: played.steps[index], index])
        for index, row in enumerate(landmarks.tolist())
    ]


def check_plan(found: dict[str, Any], plan: Plan) -> None:
    """Check actions, costs and claims of a plan that the page made."""
    assert tuple(map(tuple, found["actions"])) == plan.actions
    assert found["success"] == plan.success
    assert tuple(map(tuple, found["claims"])) == plan.claims
    if plan.success:
        assert [found[name] for name in COSTS] == [getattr(plan, name) for name in COSTS]


@pytest.mark.parametrize("name", ["pretrained", "pretrained-distilled"])
def test_page_acts_as_the_policy(name, visit, tmp_path):
    """On 200 problems every action is the Python policy's, and every cost that of the rules."""
    folder = PLAYGROUND
    if name != "pretrained":
        folder = page_with(export(name), tmp_path / "page")
    found = visit(folder=folder).evaluate(PLAY, problems().tolist())
    for one, plan in zip(found, greedy_plans(name, problems()), strict=True):
        check_plan(one["network"], plan)


@pytest.mark.parametrize("name", ["pretrained", "pretrained-distilled"])
def test_page_acts_as_the_rounded_policy(name, visit, tmp_path):
    """On as many problems as are asked for, with the same weights no action is another."""
    save_policy(
        tmp_path / "policy.safetensors", load_policy(name).network, GRID, half_precision=True
    )
    shutil.copy(PRETRAINED / name / "config.json", tmp_path)  # which grid they are for
    page = visit(folder=page_with(export(name), tmp_path / "page"))
    for part in np.array_split(problems(N_ROUNDED), -(-N_ROUNDED // 500)):
        found = page.evaluate(PLAY, part.tolist())
        for one, plan in zip(found, greedy_plans(tmp_path, part), strict=True):
            check_plan(one["network"], plan)


def test_page_finds_the_optimum(visit):
    """On 200 problems the page's optimum costs what the exact solver's does, in all three costs."""
    found = visit().evaluate(PLAY, problems().tolist())
    for one, landmarks in zip(found, problems().tolist(), strict=True):
        plan = solve(Problem(GRID, landmarks))
        assert plan.status == "optimal"
        assert [one["optimum"][name] for name in COSTS] == [getattr(plan, name) for name in COSTS]
        assert tuple(map(tuple, one["optimum"]["claims"])) == plan.claims


SPECS = {
    "plain": {},
    "dueling": {"dueling": True},
    "landmarks": {"landmark_units": 5},
    "routes": {"route_units": 3},
    "all": {"landmark_units": 5, "route_units": 3, "dueling": True},
}


def make_policy(folder: Path, units: dict[str, Any]) -> Path:
    """Save a network with random weights as a run, in 16 bits."""
    spec = network_spec("pairs", 3, 5, 4, 49, 24, outputs="joint", code_units=7, **units)
    folder.mkdir()
    network = build_network(spec, torch_generator(np.random.SeedSequence(3)))
    save_policy(folder / "policy.safetensors", network, GRID, half_precision=True)
    options = {"n_agents": 3, "n_landmarks": 5, "max_cycles": 50}
    config = {"grid": GRID.to_text(), "options": options, "training_problems": []}
    (folder / "config.json").write_text(json.dumps(config), encoding="utf-8")
    return folder


def observations(n: int) -> np.ndarray:
    """Return global observations that episodes can come to: nobody on an unvisited landmark."""
    rng = np.random.default_rng(5)
    rows = []
    for landmarks in sample_problems(GRID, n, n_landmarks=5, seed=12):
        cells = rng.choice([*GRID.reachable, GRID.depot], size=3)
        visited = np.isin(landmarks, cells) | (rng.random(5) < 0.3)
        rows.append([*cells, *landmarks, *visited])
    return np.array(rows, np.float32)


@pytest.mark.parametrize("units", SPECS.values(), ids=SPECS)
def test_every_network_of_the_family(units, visit, tmp_path):
    """With any parts, also unsolved for 50 steps, values and actions are those of Python."""
    run = make_policy(tmp_path / "run", units)
    page = visit(folder=page_with(export(str(run)), tmp_path / "page"))
    seen = observations(100)
    rows = [[row[:3], row[3:8], row[8:]] for row in seen.astype(int).tolist()]
    with torch.no_grad():
        expected = load_policy(run).network(torch.from_numpy(seen)).numpy()
    np.testing.assert_allclose(page.evaluate(VALUES, rows), expected, atol=1e-5, rtol=1e-5)
    plans = greedy_plans(run, problems()[:20])
    for one, plan in zip(page.evaluate(PLAY, problems()[:20].tolist()), plans, strict=True):
        check_plan(one["network"], plan)
    assert not all(plan.success for plan in plans)


def test_unsolved_is_said(visit, tmp_path):
    """An episode that ends at the step limit is called unsolved, and has no gap."""
    run = make_policy(tmp_path / "run", {})
    page = visit(folder=page_with(export(str(run)), tmp_path / "page"))
    plan = greedy_plans(run, np.array([FIRST]))[0]
    assert not plan.success
    assert page.inner_text("#verdict").startswith("Unsolved: at the limit of 50 steps")
    assert page.inner_text("#network-note") == "unsolved"
    row = "#costs [data-cost=coverTime] td"
    assert page.locator(row).all_inner_texts() == ["unsolved", "12", "\u2013"]
    page.fill("#time", "50")
    assert page.inner_text("#network-note").endswith("of 5 flags, unsolved")


def test_results_are_shown(visit):
    """Costs, gap and claims in the tables are those of the plans."""
    page = visit("#0,6,20,42,48")
    network, optimum = greedy_plans("pretrained", np.array([FIRST]))[0], solve(Problem(GRID, FIRST))
    for cost in COSTS:
        first, *others = cost.split("_")
        row = f"#costs [data-cost={first}{''.join(word.title() for word in others)}] td"
        shown = page.locator(row).all_inner_texts()
        assert shown[:2] == [str(getattr(network, cost)), str(getattr(optimum, cost))]
    gap = 100 * (network.cover_time - optimum.cover_time) / optimum.cover_time
    shown = page.locator("#costs [data-cost=coverTime] td").nth(2).inner_text()
    assert float(shown.removesuffix(" %")) == pytest.approx(gap, abs=0.05)
    for agent in range(3):
        cells = page.locator("#claims tbody tr").nth(agent).locator("td").all_inner_texts()
        for plan, text in zip((network, optimum), cells, strict=True):
            claims = zip(plan.claims[agent], plan.claim_steps[agent], strict=True)
            said = [f"{'ABCDE'[FIRST.index(cell)]} at {step}" for cell, step in claims]
            assert " ".join(text.split()) == (" ".join(said) or "nothing")


def press(page: Page, keys: str) -> None:
    for key in keys.split():
        page.keyboard.press(key)


def flags_of(page: Page) -> list[int]:
    """Return where the page says that flags are."""
    cells = page.locator("#network-board [data-cell][aria-label*=': flag']")
    return [int(cell.get_attribute("data-cell") or -1) for cell in cells.all()]


def test_keyboard_moves_a_flag(visit):
    """Arrows move a cursor that is seen; Enter and Space pick up and put down; walls refuse."""
    page = visit()
    page.focus("#network-board [tabindex='0']")
    press(page, "Home ArrowUp ArrowUp ArrowUp ArrowUp")
    focused = "document.activeElement"
    assert page.evaluate(f"{focused}.getAttribute('aria-label')") == "row 1, column 1: flag A"
    assert page.evaluate(f"getComputedStyle({focused}).outlineStyle") == "solid"
    press(page, "Enter")
    assert "picked up" in page.inner_text("#message")
    press(page, "ArrowDown ArrowRight Space")
    assert page.inner_text("#message") == "A flag cannot stand on a wall."
    press(page, "ArrowUp Space")
    assert flags_of(page) == [1, 6, 20, 42, 48]
    assert page.input_value("#link").endswith("#1,6,20,42,48")
    press(page, "Enter Escape")
    assert "back in its place" in page.inner_text("#message")
    press(page, "Delete")
    assert flags_of(page) == [6, 20, 42, 48]
    assert page.inner_text("#verdict") == "Put down one more flag."


def test_five_flags_from_nothing(visit):
    """From an empty grid five presses make a problem; a sixth flag is refused."""
    page = visit()
    page.click("#clear")
    assert flags_of(page) == []
    assert page.is_disabled("#play")
    page.focus("#network-board [tabindex='0']")
    press(page, "ArrowRight Enter ArrowRight Enter ArrowRight Enter ArrowUp Enter ArrowUp ArrowUp")
    assert flags_of(page) == [20, 25, 26, 27]
    press(page, "Enter")
    assert flags_of(page) == [6, 20, 25, 26, 27]
    assert page.url.endswith("#6,20,25,26,27")
    press(page, "ArrowLeft Enter")
    assert "pick one up first" in page.inner_text("#message")
    assert flags_of(page) == [6, 20, 25, 26, 27]


def test_mouse_moves_a_flag(visit):
    """A flag goes where one clicks next, or where it is dragged to, on either board."""
    page = visit()
    page.click("#network-board [data-cell='0']")
    page.click("#network-board [data-cell='2']")
    assert flags_of(page) == [2, 6, 20, 42, 48]
    page.drag_and_drop("#optimum-board [data-cell='48']", "#optimum-board [data-cell='46']")
    assert flags_of(page) == [2, 6, 20, 42, 46]
    page.drag_and_drop("#optimum-board [data-cell='46']", "#optimum-board [data-cell='45']")
    assert page.inner_text("#message") == "A flag cannot stand on a wall."
    page.click("#random")
    assert len(set(flags_of(page)) & set(GRID.reachable.tolist())) == 5


def test_a_dragged_flag_is_carried(visit):
    """Once it leaves its cell a flag is picked up; on a wall or beside the grid it is put back."""
    page = visit()
    board, cells = "#network-board", page.locator("#network-board .cells [data-cell]")
    carried = page.locator(f"{board} .flag.carried")
    for where, said in ((8, "cannot stand on a wall"), (None, "is back in its place")):
        cells.nth(0).hover()
        page.mouse.down()
        assert carried.count() == 0
        cells.nth(1).hover()
        assert carried.count() > 0
        assert "Flag A is picked up" in page.inner_text("#message")
        if where is None:
            page.mouse.move(2, 2)
        else:
            cells.nth(where).hover()
        page.mouse.up()
        assert carried.count() == 0
        assert said in page.inner_text("#message")
        assert flags_of(page) == FIRST
    page.click("#step")
    assert page.inner_text("#message") == ""


@pytest.mark.parametrize(("key", "left"), [("Escape", FIRST), ("Delete", FIRST[1:])])
def test_a_key_ends_a_drag(key, left, visit):
    """A flag that a key has put back or away while it was dragged is not put down any more."""
    page = visit()
    cells = page.locator("#network-board .cells [data-cell]")
    cells.nth(0).focus()
    cells.nth(0).hover()
    page.mouse.down()
    cells.nth(2).hover()
    page.keyboard.press(key)
    page.mouse.up()
    assert flags_of(page) == left


def test_only_the_first_finger_drags(visit):
    """Another finger neither lifts nor drops the flag that the first one rests on."""
    page = visit(has_touch=True)
    touch = page.context.new_cdp_session(page)

    def point(cell: int, finger: int) -> dict[str, float]:
        box = page.locator("#network-board .cells [data-cell]").nth(cell).bounding_box()
        middle = {"x": box["x"] + box["width"] / 2, "y": box["y"] + box["height"] / 2}
        return {**middle, "id": finger}

    def send(kind: str, *points: dict[str, float]) -> None:
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": list(points)})

    send("touchStart", point(0, 0))
    send("touchStart", point(0, 0), point(17, 1))
    send("touchMove", point(0, 0), point(31, 1))
    assert page.locator("#network-board .flag.carried").count() == 0
    send("touchEnd", point(31, 1))
    assert flags_of(page) == FIRST


def test_arrows_start_where_the_focus_is(visit):
    """Whatever has put the focus on a cell, arrow keys go on from there."""
    page = visit()
    page.focus("#network-board [data-cell='32']")
    page.keyboard.press("ArrowRight")
    assert page.evaluate("document.activeElement.dataset.cell") == "33"


def test_other_buttons_drag_nothing(visit):
    """The right button's menu leaves the flags where they are."""
    page = visit()
    cells = page.locator("#network-board .cells [data-cell]")
    for button in ("right", "middle"):
        cells.nth(0).hover()
        page.mouse.down(button=button)
        cells.nth(2).hover()
        page.mouse.up(button=button)
    assert flags_of(page) == FIRST


def test_keyboard_keeps_its_place(visit):
    """A button that is of no use any more hands the keyboard on to the next."""
    page = visit()
    page.focus("#step")
    for _ in range(18):
        page.keyboard.press("Enter")
    assert page.inner_text("#now").startswith("Step 18 of 18")
    assert page.evaluate("document.activeElement.id") == "play"
    page.focus("#start")
    page.keyboard.press("Enter")
    assert page.evaluate("document.activeElement.id") == "play"


def test_time_passes(visit):
    """Steps go on and back, and what plays comes to its end by itself."""
    page = visit()
    last = int(page.get_attribute("#time", "max") or 0)
    for _ in range(6):
        page.click("#step")
    assert page.inner_text("#now").startswith(f"Step 6 of {last}")
    page.click("#back")
    assert page.input_value("#time") == "5"
    page.fill("#time", str(last - 2))
    page.select_option("#speed", "fast")
    page.click("#play")
    assert page.inner_text("#play") == "Pause"
    page.wait_for_function("document.querySelector('#play').innerText === 'Play'")
    assert page.input_value("#time") == str(last)
    assert page.inner_text("#optimum-note") == "all 5 flags at step 12"
    page.click("#start")
    assert page.input_value("#time") == "0"


def test_a_link_comes_back(visit):
    """Who opens a copied link sees the same flags and the same plans."""
    page = visit()
    page.click("#random")
    link = page.input_value("#link")
    other = visit(link[link.index("#") :])
    assert flags_of(other) == flags_of(page)
    for shown in ("#verdict", "#costs", "#claims"):
        assert other.inner_text(shown) == page.inner_text(shown)
    assert other.is_hidden("#alert")


BAD_LINKS = {
    "#0,6,20,42": "4 cells, not 5",
    "#0,6,20,42,47,48": "6 cells, not 5",
    "#0,6,20,42,42": "a cell twice",
    "#0,6,20,42,49": "Cell 49 is not on the grid",
    "#0,6,8,42,48": "Cell 8 is a wall",
    "#0,6,20,24,48": "Cell 24 is the depot",
    "#0,6,20,42,-1": "not a list of cell numbers",
    "#0,6,20,42,4e1": "not a list of cell numbers",
    "#%E0%A4%A": "not a list of cell numbers",
    "#" + "0," * 5000: "not a list of cell numbers",
    "#<img src=x onerror=alert(1)>": "not a list of cell numbers",
}


def test_bad_links_are_refused(visit):
    """A link that is no problem is refused in words, and the flags stay where they are."""
    page = visit()
    page.evaluate("location.hash = '#1,6,20,42,48'")
    for hash_, said in BAD_LINKS.items():
        page.evaluate("hash => { location.hash = hash }", hash_)
        alert = "said => document.querySelector('#alert').textContent.includes(said)"
        page.wait_for_function(alert, arg=said)
        assert page.is_visible("#alert")
        assert page.url.endswith("#1,6,20,42,48")
        assert flags_of(page) == [1, 6, 20, 42, 48]
        page.evaluate("document.querySelector('#alert').textContent = ''")
    page.evaluate("location.hash = '#2%2C6%2C20%2C42%2C48'")
    page.wait_for_function("document.querySelector('#alert').hidden")
    assert flags_of(page) == [2, 6, 20, 42, 48]


@pytest.mark.parametrize("hash_", ["#0,6,8,42,48", "#<img src=x onerror=alert(1)>"])
def test_page_opens_on_a_bad_link(hash_, visit):
    """Opened with a link that is no problem, the page says so and shows its first one."""
    page = visit(hash_)
    assert page.inner_text("#alert").startswith("This link leads nowhere. ")
    assert "#0,6,20,42,48" in page.inner_text("#alert")
    assert flags_of(page) == FIRST
    page.click("#random")
    assert page.is_hidden("#alert")


CONTRAST = """selector => {
    const channels = colour => colour.match(/[0-9.]+/g).slice(0, 3).map(Number);
    const light = colour => channels(colour).map(c => c / 255)
        .map(c => c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4)
        .reduce((sum, c, i) => sum + [0.2126, 0.7152, 0.0722][i] * c, 0);
    const element = document.querySelector(selector);
    let ground = element;
    const colourOf = e => getComputedStyle(e).backgroundColor;
    while (colourOf(ground) === "rgba(0, 0, 0, 0)") ground = ground.parentElement;
    const pair = [light(getComputedStyle(element).color), light(colourOf(ground))];
    return (Math.max(...pair) + 0.05) / (Math.min(...pair) + 0.05);
}"""


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_small_letters_stand_out(scheme, visit):
    """Letters have a contrast of 4.5 or more to what they stand on, as WCAG 2 asks for."""
    page = visit(color_scheme=scheme)
    page.evaluate("document.querySelector('#verdict').dataset.kind = 'gap'")
    chips = [f".agent-{agent} .chip" for agent in range(3)]
    for selector in ("#verdict", ".fine", ".about p", "thead th", "#now", "#play", *chips):
        assert page.evaluate(CONTRAST, selector) >= 4.5, selector


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [320, 360])
def test_readable_on_a_phone(scheme, width, visit):
    """On a narrow screen nothing reaches over the side; either plan can be looked at."""
    page = visit("#0,6,20,24,48", viewport={"width": width, "height": 740}, color_scheme=scheme)
    assert page.is_visible("#alert")
    for view, hidden in (("network", "optimum"), ("optimum", "network")):
        page.locator(f"#views [value={view}]").check(force=True)
        assert page.is_visible(f"#{view}-board")
        assert page.is_hidden(f"#{hidden}-board")
        assert page.evaluate("document.documentElement.scrollWidth") == width
        assert page.evaluate("document.body.scrollWidth") <= width
    floor = page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert (max(map(int, floor[4:-1].split(","))) < 60) == (scheme == "dark")


@pytest.mark.parametrize(
    ("damage", "said"),
    [("missing", "is missing"), ("cut", "has another length"), ("wrong", "holds what is no")],
)
def test_damaged_weights_are_said(damage, said, visit, tmp_path):
    """Without readable weights the page says so, and does not break."""
    script = (PLAYGROUND / "weights.js").read_text(encoding="utf-8")
    start = script.index('"hidden.weight"')
    data = script.index('"data": "', start) + len('"data": "')
    scripts = {
        "missing": "",
        "cut": f"{script[:data]}{script[data + 8 :]}",
        "wrong": f"{script[:data]}AH4AfgAA{script[data + 8 :]}",  # not a number
    }
    page = visit(folder=page_with(scripts[damage], tmp_path / "page"))
    assert page.inner_text("#alert").startswith("The network cannot be read: ")
    assert said in page.inner_text("#alert")
    assert "export_playground.py" in page.inner_text("#alert")
    assert page.locator("button:enabled").count() == 0


SEEDED = """let state = 4; Math.random = () => {
    state = (state * 1103515245 + 12345) % 2147483648;
    return state / 2147483648;
}; 0"""


def test_a_miss_is_found_and_its_gap_told(visit):
    """Problems that the page finds have a longer cover time; the gap is told to the optimum."""
    page = visit()
    page.evaluate(SEEDED)  # so that the page draws the same problems each time
    for _ in range(3):
        page.click("#miss")
        said = "document.querySelector('#message').textContent.startsWith('Found after')"
        page.wait_for_function(said, timeout=60_000)
        landmarks = np.array([flags_of(page)])
        plan, optimum = greedy_plans("pretrained", landmarks)[0], solve(Problem(GRID, landmarks[0]))
        assert plan.cover_time > optimum.cover_time
        shown = page.locator("#costs [data-cost=coverTime] td").all_inner_texts()
        assert shown[:2] == [str(plan.cover_time), str(optimum.cover_time)]
        gap = 100 * (plan.cover_time - optimum.cover_time) / optimum.cover_time
        assert float(shown[2].removesuffix(" %")) == pytest.approx(gap, abs=0.05)
        assert page.inner_text("#verdict").startswith(f"Gap {shown[2]}: ")
        assert page.get_attribute("#verdict", "data-kind") == "gap"


def test_boards_follow_the_claims(visit):
    """After each step just the flags that a plan has claimed by then are visited, and counted."""
    page = visit("#0,6,20,42,48")
    plans = {"network": greedy_plans("pretrained", np.array([FIRST]))[0]}
    plans["optimum"] = solve(Problem(GRID, FIRST))
    for step in range(1, max(plan.cover_time for plan in plans.values()) + 1):
        page.fill("#time", str(step))
        for name, plan in plans.items():
            claims = dict(zip(sum(plan.claims, ()), sum(plan.claim_steps, ()), strict=True))
            visited = [cell for cell in FIRST if claims[cell] <= step]
            flags = page.locator(f"#{name}-board svg g.flag:has(path.cloth)")
            shown = [" visited" in (flag.get_attribute("class") or "") for flag in flags.all()]
            assert shown == [cell in visited for cell in FIRST]
            labelled = page.locator(f"#{name}-board [data-cell][aria-label*='visited by agent']")
            assert labelled.count() == len(visited)
            note = page.inner_text(f"#{name}-note")
            if len(visited) < 5:
                assert note == f"{len(visited)} of 5 flags"
            else:
                assert note == f"all 5 flags at step {plan.cover_time}"


ARROWS = """board => Array.from(document.querySelectorAll(`#${board}-board svg .arrow`), arrow => ({
    agent: Number(arrow.parentNode.getAttribute("class").match(/agent-([0-9]+)/)[1]),
    home: arrow.classList.contains("home"),
    at: arrow.getAttribute("transform").match(/-?[0-9.]+/g).map(Number),
}))"""


def test_arrows_are_the_moves_of_the_tours(visit):
    """Each move has an arrow to the right of its middle line, pale from the last claim on."""
    page, plan = visit("#0,6,20,42,48"), solve(Problem(GRID, FIRST))
    found = page.evaluate(ARROWS, "optimum")
    for agent, (tour, claims) in enumerate(zip(plan.tours, plan.claims, strict=True)):
        arrows = [arrow for arrow in found if arrow["agent"] == agent]
        assert len(arrows) == max(len(tour) - 1, 0)
        turn = tour.index(claims[-1]) if claims else 0
        assert [arrow["home"] for arrow in arrows] == [move >= turn for move in range(len(arrows))]
        for (start, end), arrow in zip(itertools.pairwise(tour), arrows, strict=True):
            (down, across), (to_down, to_across) = divmod(start, 7), divmod(end, 7)
            heading = (to_across - across, to_down - down)
            x, y, _ = arrow["at"]
            aside = (x - 100 * across - 50) * -heading[1] + (y - 100 * down - 50) * heading[0]
            assert 0 < aside < 50


def test_small_weights_are_read(visit, tmp_path):
    """A weight below the least normal number of 16 bits is not taken for 0."""
    run = make_policy(tmp_path / "run", {})
    network = load_policy(run).network
    with torch.no_grad():
        for weight in network.parameters():
            weight.mul_(2.0**-17)
    save_policy(run / "policy.safetensors", network, GRID, half_precision=True)
    page = visit(folder=page_with(export(str(run)), tmp_path / "page"))
    seen = observations(20)
    rows = [[row[:3], row[3:8], row[8:]] for row in seen.astype(int).tolist()]
    with torch.no_grad():
        expected = load_policy(run).network(torch.from_numpy(seen)).numpy()
    assert np.abs(expected).max() > 0
    np.testing.assert_allclose(page.evaluate(VALUES, rows), expected, rtol=1e-3, atol=1e-12)
