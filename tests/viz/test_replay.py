import base64
import dataclasses
import html
import re

import numpy as np
import pytest

from tests.helpers.browser import browser, served
from tests.helpers.pages import page_data
from tests.helpers.synthetic_results import blimp_result, blimp_results, car_result
from vcbf_drake.barriers import BoxObstacle, SphereObstacle
from vcbf_drake.safety.settings import METHODS
from vcbf_drake.viz import write_replay
from vcbf_drake.viz.replay.scene import tube
from vcbf_drake.viz.runs import label_runs
from vcbf_drake.viz.stage import MAX_FRAMES, set_stage


def commands(page):
    """What the page tells Meshcat, as bytes."""
    found = re.findall(r'fetch\("data:application/octet-binary;base64,([^"]+)', page)
    return [base64.b64decode(text) for text in found]


def signed_volume(vertices, faces):
    """By the divergence theorem: positive when the faces look outwards."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0


@pytest.fixture(scope="module")
def page_path(tmp_path_factory):
    path = tmp_path_factory.mktemp("replay") / "made" / "blimp.html"
    return write_replay(blimp_results(), path)


@pytest.fixture(scope="module")
def page(page_path):
    return page_path.read_text(encoding="utf-8")


def test_the_page_is_one_file_that_drives_meshcats_own_player(page):
    assert page.count("</body>") == 1
    assert "viewer.animator" in page
    assert page.count("<title>A blimp among spheres - vcbf_drake</title>") == 1
    assert "class Animator" in page  # Meshcat's code itself is inside.
    assert not re.search(r'<(script|link|img)[^>]+(src|href)="(?!data:)', page)
    assert len(page.encode()) < 4e6


def test_the_data_are_finite_json_and_are_those_of_the_log(page):
    data = page_data(page)
    results = blimp_results()
    assert [run["label"] for run in data["runs"]] == [
        "Robust CBF-QP",
        "DOB-CBF-QP",
        "DOB-VCBF-QP",
    ]
    assert data["duration"] == pytest.approx(19.5)
    for run, result in zip(data["runs"], results, strict=True):
        ticks = np.searchsorted(result.log["time"], np.array(run["time"]) - 1e-3)
        least = result.log["barriers"].min(axis=1)[ticks]
        np.testing.assert_allclose(run["barrier"], least, rtol=1e-4)
        assert len(run["time"]) <= 800
        assert run["time"][-1] == pytest.approx(result.log["time"][-1], rel=1e-4)


def test_what_is_not_a_number_is_null(page):
    run = page_data(page)["runs"][1]
    assert run["volume"][-1] is None  # The set is empty at the infeasible tick.
    assert None not in run["volume"][:-1]


def test_the_legend_knows_what_happened_and_when(page):
    robust, ours, best = page_data(page)["runs"]
    assert robust["events"][0]["kind"] == "reached"
    assert ours["events"] == [
        {"time": 7.6, "kind": "infeasible", "text": "infeasible since 7.6 s"}
    ]
    assert best["events"][0]["text"] == "reached at 19.5 s"


def test_only_the_infeasible_run_gets_a_marker_and_it_appears_in_time(page):
    animation = next(c for c in commands(page) if b"set_animation" in c)
    assert b"/drake/failure/1" in animation and b".visible" in animation
    assert b"/drake/failure/0" not in animation
    assert b"/drake/failure/2" not in animation


def test_the_scenarios_words_cannot_become_markup(tmp_path):
    words = "<script>alert(1)</script> & more\n</script><b>bold</b>"
    result = blimp_result(end=2.0)
    result.scenario.description, result.scenario.name = words, "<i>"
    page = write_replay([result], tmp_path / "page.html").read_text()
    assert "<script>alert" not in page
    assert "<b>bold" not in page
    assert html.escape("<script>alert(1)</script> & more") in page


def test_the_same_results_give_the_same_page(tmp_path):
    """But for the identifiers of objects, which Meshcat draws at random."""
    results = [blimp_result("dob-cbf-qp", 3.0, infeasible=True), blimp_result(end=4.0)]
    random = re.compile(rb"[0-9a-f]{8}(?:-[0-9a-f]{4}){3}-[0-9a-f]{12}")
    first, second = (
        write_replay(results, tmp_path / name).read_text() for name in ("a", "b")
    )
    for one, other in zip(commands(first), commands(second), strict=True):
        assert random.sub(b"", one) == random.sub(b"", other)
    recorded = re.compile(r"base64,[^\"]+")
    assert recorded.sub("", first) == recorded.sub("", second)


def test_only_moving_obstacles_are_recorded(tmp_path):
    page = write_replay([car_result()], tmp_path / "car.html").read_text()
    animation = next(c for c in commands(page) if b"set_animation" in c)
    assert b"/drake/obstacles/2" in animation
    assert b"/drake/obstacles/0" not in animation


def test_frames_follow_the_log_and_rest_when_it_ends():
    results = blimp_results()
    stage = set_stage(results)
    time, short = stage.time, stage.paths[1]
    assert np.diff(time) == pytest.approx(0.1)
    log = results[1].log
    now = log["time"][137]
    place = [np.interp(now, time, axis) for axis in short.T]
    np.testing.assert_allclose(place, log["state"][137, :3], atol=2e-3)
    after = short[time > 7.6]
    np.testing.assert_array_equal(after, np.tile(log["state"][-1, :3], (len(after), 1)))
    assert np.all(stage.view.low < stage.view.high)


def test_a_long_run_has_no_more_frames():
    result = car_result(end=60.0)
    stage = set_stage([result])
    assert len(stage.time) <= MAX_FRAMES + 1
    assert stage.time[-1] == pytest.approx(60.0)


def test_many_runs_still_make_a_small_page(tmp_path):
    runs = [blimp_result(method) for method in METHODS]
    assert write_replay(runs, tmp_path / "page.html").stat().st_size < 4e6


def test_the_car_drives_in_the_plane_and_turns_by_its_heading():
    result = car_result()
    stage = set_stage([result])
    assert np.all(stage.paths[0][:, 2] == 0.0)
    ahead = stage.bodies[0].poses[0].rotation() @ np.array([1.0, 0.0, 0.0])
    turn = np.arctan2(ahead[1], ahead[0])
    assert turn == pytest.approx(result.log["state"][0, 3])


def test_a_vehicle_larger_than_its_obstacles_is_drawn_smaller():
    result = blimp_result(end=2.0)
    assert set_stage([result]).fraction == 1
    small = [dataclasses.replace(o, radius=0.2) for o in result.scenario.obstacles]
    scenario = dataclasses.replace(result.scenario, obstacles=small)
    stage = set_stage([dataclasses.replace(result, scenario=scenario)])
    assert stage.fraction == 3
    assert stage.run.vehicle.length == pytest.approx(0.77)


def test_the_view_shows_the_ways_beside_a_tower():
    result = blimp_result(end=2.0)
    tower = BoxObstacle([3.0, 3.0, 50.0], [0.2, 0.2, 50.0])
    scenario = dataclasses.replace(result.scenario, obstacles=[tower])
    stage = set_stage([dataclasses.replace(result, scenario=scenario)])
    way = np.linalg.norm(stage.tasks[0][2] - stage.tasks[0][1])
    assert stage.view.points[:, 2].max() < stage.paths[0][:, 2].max() + way


def test_no_obstacles_are_no_trouble(tmp_path):
    result = blimp_result(end=2.0)
    scenario = dataclasses.replace(result.scenario, obstacles=[])
    log = result.log | {"barriers": np.empty((len(result.log["time"]), 0))}
    result = dataclasses.replace(result, scenario=scenario, log=log)
    page = write_replay([result], tmp_path / "page.html").read_text()
    assert set(page_data(page)["runs"][0]["barrier"]) == {None}


def vehicles(methods):
    """Two cars of one scenario that go opposite ways, under each method."""
    results = []
    for method in methods:
        for name, end in (("north", 3.0), ("south", 2.0)):
            result = car_result(end=end)
            changed = {"name": name, "method": method}
            if name == "south":
                changed["target"] = [-4.0, 1.0]
            scenario = dataclasses.replace(result.scenario, **changed)
            results.append(dataclasses.replace(result, scenario=scenario))
    return results


def test_every_vehicle_of_a_scenario_is_solid(tmp_path):
    results = vehicles(["dob-vcbf-qp"])
    runs = label_runs(results)
    assert [run.label for run in runs] == ["north", "south"]
    assert not any(run.ghost for run in runs)
    assert len({run.color for run in runs}) == 2
    stage = set_stage(results)
    assert [name for name, _, _ in stage.tasks] == ["north", "south"]
    assert stage.tasks[1][2].tolist() == [-4.0, 1.0, 0.0]
    assert stage.view.low[0] < -4.0
    data = page_data(write_replay(results, tmp_path / "page.html").read_text())
    assert [run["ghost"] for run in data["runs"]] == [False, False]
    places = [each["text"] for each in data["labels"] if each["kind"] == "place"]
    assert places == ["start north", "target north", "start south", "target south"]


def test_only_the_last_run_of_each_vehicle_is_solid():
    runs = label_runs(vehicles(["dob-cbf-qp", "dob-vcbf-qp"]))
    assert [run.ghost for run in runs] == [True, True, False, False]
    assert [run.label for run in runs][::3] == [
        "north, DOB-CBF-QP",
        "south, DOB-VCBF-QP",
    ]
    assert len({run.color for run in runs}) == 4


def test_runs_of_one_method_are_told_apart():
    results = [car_result(end=2.0) for _ in range(3)]
    for result, gain in zip(results, (0.2, 0.6, 1.0), strict=True):
        result.scenario.volume.gain = gain
    runs = label_runs(results)
    labels = [run.label for run in runs]
    assert labels == [f"DOB-VCBF-QP, gain = {gain}" for gain in (0.2, 0.6, 1.0)]
    assert len({run.color for run in runs}) == 3
    assert runs[-1].color == "#0072b2"


def test_bad_input_is_refused_in_one_line(tmp_path):
    with pytest.raises(ValueError, match="results: got none"):
        write_replay([], tmp_path / "page.html")


def test_rings_look_outwards_and_have_the_right_size():
    angle = np.linspace(0.0, 2.0 * np.pi, 61)
    circle = 0.9 * np.column_stack([0.0 * angle, np.cos(angle), np.sin(angle)])
    vertices, faces = tube(circle, [1.0, 0.0, 0.0], 0.1)
    distance = np.linalg.norm(vertices.reshape(61, -1, 3) - circle[:, None], axis=2)
    np.testing.assert_allclose(distance, 0.1)
    volume = 2.0 * np.pi**2 * 0.9 * 0.1**2
    assert signed_volume(vertices, faces) == pytest.approx(volume, rel=0.12)


def test_a_straight_tube_has_a_cylinders_volume():
    way = np.linspace([-1.0, 0.0, 0.0], [1.0, 0.0, 0.0], 5)
    vertices, faces = tube(way, [0.0, 0.6, 0.8], 0.1, sides=64)
    # Its ends are open: they add nothing to the integral only if they hold the origin.
    side = 2.0 / 3.0 * np.pi * 0.1**2 * 2.0
    assert signed_volume(vertices, faces) == pytest.approx(side, rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fragment", "clock", "words"),
    [("#t=5", "5.00 s", "under way"), ("#t=9", "9.00 s", "infeasible since 7.6 s")],
)
def test_a_real_browser_shows_it(page_path, fragment, clock, words):
    with browser() as tab:
        tab.open(page_path.as_uri() + fragment)
        text = "document.getElementById('{}')?.innerText ?? null".format
        assert tab.settle(text("clock")).startswith(clock)
        assert re.search(rf"DOB-CBF-QP\s+{words}", tab.settle(text("legend")))
        count = "document.querySelectorAll('{}').length".format
        assert tab.evaluate(count("#plots figure")) == 4
        curves = tab.evaluate(count("#plots .curve"))
        # Barrier, volume and three inputs (the slack is 0); 3 runs, pale and strong.
        assert curves == 5 * 3 * 2
        assert tab.evaluate("document.querySelector('canvas').width > 100")
        assert tab.evaluate("document.documentElement.className") == ""
        panel = "getComputedStyle(document.querySelector('.dg')).display"
        assert tab.evaluate(panel) == "none"
        assert not tab.errors


# Where the camera and the labels are. Meshcat's scene is z up, Three.js' y up.
VIEW = """(() => {
  const page = %s;
  const label = (text) => {
    const spans = [...page.document.querySelectorAll("#labels .place")];
    const box = spans.find((span) => span.textContent === text).getBoundingClientRect();
    return [box.left, box.top, box.right, box.bottom].map(Math.round);
  };
  const camera = page.viewer?.camera;
  const seen = page.document.getElementById("meshcat-pane");
  if (camera?.fov !== 32 || !page.viewer.animator.actions.length || !seen.clientWidth) {
    return null;  // The lens and the motion have not been read, or it is not in sight.
  }
  const plain = ({ x, y, z }) => [x, -z, y].map((value) => Number(value.toFixed(5)));
  return {
    camera: plain(camera.position),
    target: plain(page.viewer.controls.target),
    labels: { start: label("start"), target: label("target") },
    pane: [seen.clientWidth, seen.clientHeight],
    vehicle: page.viewer.scene_tree.find(
      ["drake", "vehicle", "2", "point"]).object.position.x,
    time: Math.max(...page.viewer.animator.actions.map((action) => action.time)),
  };
})()"""
LATE = """<script>
  const fetchNow = window.fetch;
  let position = 0;
  window.fetch = async (...what) => {
    position += 1;  // The last command first, the whole seconds after the page began.
    await new Promise((done) => setTimeout(done, 4000 - 20 * position));
    return fetchNow(...what);
  };
</script>"""
FRAME = """<!doctype html><body><div style="display: none">
<iframe src="page.html#t=5" style="width: 900px; height: 600px"></iframe></div>
<script>
  setTimeout(() => { document.querySelector("div").style.display = ""; }, 1500);
</script>
"""


def on_the_pane(point, view):
    """The pixels that a pinhole camera with Meshcat's lens has for a point."""
    camera, target = np.array(view["camera"]), np.array(view["target"])
    toward = (target - camera) / np.linalg.norm(target - camera)
    right = np.cross(toward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    offset = np.asarray(point) - camera
    width, height = view["pane"]
    scale = 0.5 * height / np.tan(np.deg2rad(16.0)) / (offset @ toward)
    up = np.cross(right, toward)
    return [
        0.5 * width + scale * (offset @ right),
        0.5 * height - scale * (offset @ up),
    ]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("how", "size"),
    [("plain", (1280, 800)), ("frame", (1280, 800)), ("late", (1920, 1080))],
)
def test_it_opens_with_everything_in_view(page, tmp_path, how, size):
    (tmp_path / "page.html").write_text(page, encoding="utf-8")
    late = page.replace("<head>", "<head>" + LATE, 1)
    (tmp_path / "late.html").write_text(late, encoding="utf-8")

    (tmp_path / "frame.html").write_text(FRAME, encoding="utf-8")
    address = {"plain": "page.html#t=5", "frame": "frame.html", "late": "late.html#t=5"}
    with browser(*size) as tab, served(tmp_path) as root:
        tab.open(f"{root}/{address[how]}")
        page_seen = "window.frames[0]" if how == "frame" else "window"
        view = tab.settle(VIEW % page_seen)
        # The button that a person would press when lost changes nothing.
        tab.evaluate(f"{page_seen}.document.getElementById('reset').click()")
        assert tab.settle(VIEW % page_seen) == view
        assert not tab.errors
    width, height = view["pane"]
    for point in page_data(page)["camera"]["points"]:
        x, y = on_the_pane(point, view)
        assert 0.0 < x < width and 0.0 < y < height
    for left, top, right, bottom in view["labels"].values():
        assert 0 <= left < right <= width and 0 <= top < bottom <= height
    log = blimp_results()[2].log
    target = blimp_results()[2].scenario.target[:3]
    for name, place in (("start", log["state"][0, :3]), ("target", target)):
        left, top, right, _ = view["labels"][name]
        x, y = on_the_pane(place, view)
        assert x == pytest.approx(0.5 * (left + right), abs=3.0)
        assert 0.0 < top - y < 60.0  # Below its place by the marker's size.
    assert view["time"] == pytest.approx(5.0)
    x = np.interp(5.0, log["time"], log["state"][:, 0])
    assert view["vehicle"] == pytest.approx(x, abs=0.03)


CROSSING = """(() => {
  const camera = viewer?.camera;
  const sets = document.querySelector("#plots .primary .set");
  if (!camera || camera.fov !== 32 || !sets) return null;
  const plain = ({ x, y, z }) => [x, -z, y].map((value) => Number(value.toFixed(5)));
  const pane = document.getElementById("meshcat-pane");
  return {
    camera: plain(camera.position),
    target: plain(viewer.controls.target),
    pane: [pane.clientWidth, pane.clientHeight],
    chosen: document.querySelector("#legend .primary .name").textContent,
    color: sets.parentNode.getAttribute("stroke"),
  };
})()"""


@pytest.mark.slow
def test_of_two_vehicles_all_is_in_view_and_either_is_brought_out(tmp_path):
    path = write_replay(vehicles(["dob-vcbf-qp"]), tmp_path / "page.html")
    data = page_data(path.read_text(encoding="utf-8"))
    with browser() as tab:
        tab.open(path.as_uri() + "#t=1")
        view = tab.settle(CROSSING)
        tab.evaluate("document.querySelectorAll('#legend li')[1].click()")
        other = tab.settle(CROSSING)
        assert not tab.errors
    for point in data["camera"]["points"]:
        x, y = on_the_pane(point, view)
        assert 0.0 < x < view["pane"][0] and 0.0 < y < view["pane"][1]
    shown = [(each["chosen"], each["color"]) for each in (view, other)]
    assert shown == [(run["label"], run["color"]) for run in data["runs"][::-1]]


@pytest.mark.slow
def test_it_plays_in_view_from_the_first_second(page_path):
    with browser() as tab:
        tab.open(page_path.as_uri())
        camera = f"({VIEW % 'window'})?.camera"
        playing = tab.settle(f"{camera} ?? null")
        assert tab.evaluate(
            "Number.parseFloat(document.getElementById('clock').innerText)"
        )
        tab.evaluate("document.getElementById('reset').click()")
        assert tab.settle(camera) == playing


# The scene, and the shares of the trail that are drawn.
SCENE = """(() => {
  const find = (path) => viewer.scene_tree.find(path.split("/")).object;
  const trails = viewer.scene.children.filter(
    (each) => each.geometry?.type === "TubeGeometry");
  const shares = trails.map(
    ({ geometry }) => geometry.drawRange.count / geometry.index.count);
  return shares.length < 3 || !viewer.animator.actions.length ? null : {
    time: Math.max(...viewer.animator.actions.map((action) => action.time)),
    playing: viewer.animator.playing,
    failure: find("drake/failure/1").visible,
    x: find("drake/vehicle/2/point").position.x,
    drawn: shares[2],
    rings: [...trails[1].geometry.attributes.position.array],
  };
})()"""
# Where Meshcat puts the vehicle, long after the page has moved it elsewhere.
POSE = """viewer.handle_command({
  type: "set_transform", path: "/drake/vehicle/2/point",
  matrix: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, -7, 0, 0, 1],
})"""
DRAG = """(() => {
  const plot = document.querySelector("#plots svg");
  const box = plot.getBoundingClientRect();
  const middle = box.left + (42 + box.width - 10) / 2;  // Between the margins.
  const drag = { clientX: middle, clientY: box.top + 5, buttons: 1 };
  plot.dispatchEvent(new PointerEvent("pointermove", drag));
})()"""


@pytest.mark.slow
def test_seeking_moves_the_scene(page_path):
    press = "window.dispatchEvent(new KeyboardEvent('keydown', {key: 'ArrowRight'}))"
    with browser() as tab:
        tab.open(page_path.as_uri() + "#t=5")
        report = [tab.settle(SCENE)]
        for action in (press, DRAG):
            tab.evaluate(action)
            report.append(tab.settle(SCENE))
        tab.evaluate(POSE)
        assert tab.settle(SCENE) == report[-1]
        assert not tab.errors
    log = blimp_results()[2].log
    for seen, time in zip(report, (5.0, 5.5, 19.5 / 2.0), strict=True):
        assert seen["time"] == pytest.approx(time, abs=0.02)
        assert not seen["playing"]  # The page's own clock leads.
        assert seen["drawn"] == pytest.approx(time / 19.5, abs=0.01)
        x = np.interp(time, log["time"], log["state"][:, 0])
        assert seen["x"] == pytest.approx(x, abs=0.03)
        assert seen["failure"] == (time > 7.6)
    # The trail of a run that ended early, and rests from then on, is round all along.
    data = page_data(page_path.read_text(encoding="utf-8"))
    path = np.array(data["runs"][1]["path"])
    rings = np.reshape(report[0]["rings"], (len(path), -1, 3))
    thick = np.linalg.norm(rings - path[:, None], axis=2)
    np.testing.assert_allclose(thick, 0.7 * data["sizes"]["trail"], rtol=1e-3)


# The limits' rectangle, the chosen input, and the reference, all in pixels.
CHOICE = """(() => {
  const svg = document.querySelector("#plots figure:last-child svg");
  const limits = svg?.querySelector(".limits");
  const number = (node) => (name) => Number(node.getAttribute(name));
  if (!limits || !svg.querySelector(".primary .stop")) return null;
  return {
    limits: ["x", "y", "width", "height"].map(number(limits)),
    chosen: ["cx", "cy"].map(number(svg.querySelector(".primary .stop"))),
    corners: svg.querySelector(".primary .set").points.length,
    words: [...svg.querySelectorAll(".empty")].map((node) => node.textContent),
  };
})()"""
PHONE = {"width": 390, "height": 844, "deviceScaleFactor": 2, "mobile": True}


@pytest.mark.slow
def test_the_feasible_set_is_shown_live_and_a_phone_shows_all_of_it(page_path):
    result = blimp_results()[2]
    limits = result.scenario.input_set
    with browser() as tab:
        tab.open(page_path.as_uri() + "#t=9")
        seen = tab.settle(CHOICE)
        x, y, width, height = seen["limits"]
        share = [
            (seen["chosen"][0] - x) / width,
            1.0 - (seen["chosen"][1] - y) / height,
        ]
        low, high = np.array(limits.lower[:2]), np.array(limits.upper[:2])
        # Up to 400 of the 976 ticks are in the page: the latest of them is shown.
        inputs = result.log["input"][447:451, :2]
        distance = np.abs(inputs - (low + np.array(share) * (high - low)))
        assert (distance / (high - low)).max(axis=1).min() < 2e-3
        assert seen["corners"] >= 3
        assert seen["words"] == ["DOB-CBF-QP: empty"]
        folds = "document.getElementById('card').classList.contains('folded')"
        assert tab.evaluate(folds)  # The pane is small.
        tab.evaluate("document.getElementById('fold').click()")
        tab.reload()
        tab.settle(CHOICE)
        assert not tab.evaluate(folds)  # As it was left.
        tab.call("Emulation.setDeviceMetricsOverride", **PHONE)
        tab.reload()
        tab.settle(CHOICE)
        assert tab.evaluate("window.innerWidth") == 390
        boxes = tab.evaluate(
            "[...document.querySelectorAll('#transport > *, #plots svg')]"
            ".map((node) => { const box = node.getBoundingClientRect();"
            " return [box.left, box.top, box.right, box.bottom]; })"
        )
        for left, top, right, bottom in boxes:
            assert 0 <= left < right <= 390 and 0 <= top < bottom <= 844
        assert not tab.errors


def test_a_minute_among_a_thousand_moving_discs_makes_a_small_page(tmp_path):
    rng = np.random.default_rng(0)
    discs = [
        SphereObstacle(center.tolist(), 0.2, velocity=[0.01, -0.02])
        for center in rng.uniform([0.0, 1.0], [60.0, 31.0], size=(1000, 2))
    ]
    result = car_result(end=60.0, obstacles=discs)
    path = write_replay([result], tmp_path / "page.html")
    assert path.stat().st_size < 10e6


def test_what_holds_of_the_whole_run_says_so(tmp_path):
    result = blimp_result(end=2.0)
    kept = dataclasses.replace(result, summary=result.summary | {"reasons_against": []})
    page = write_replay([kept], tmp_path / "page.html").read_text()
    assert "DOB-VCBF-QP (whole run): guaranteed" in page


@pytest.mark.parametrize(("slack", "third"), [(0.0, "Inputs"), (0.2, "Slack δ [-]")])
def test_a_slack_that_is_nothing_makes_room_for_the_inputs(tmp_path, slack, third):
    result = car_result(end=2.0)
    result.log["slack"][7] = slack
    data = page_data(write_replay([result], tmp_path / "page.html").read_text())
    assert data["plots"][2]["title"] == third
    if not slack:
        assert data["runs"][-1]["limits"] == [[-0.8, 0.8], [-0.7, 0.7]]
