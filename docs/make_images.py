"""Makes the pictures of docs/images anew; needs chromium for those of replays.

python -m docs.make_images [NAME...]
"""

import base64
from pathlib import Path
import shutil
import subprocess
import sys
import tempfile
import time

from tests.helpers.browser import browser

ROOT = Path(__file__).parents[1]
IMAGES = ROOT / "docs" / "images"
MOST = 300_000  # A picture's size [bytes].

# Whose replays are shown: the command, and when.
REPLAYS = {
    "demo": ("compare blimp-multiple-obstacles --methods dob-cbf-qp,dob-vcbf-qp", 9.5),
    "arm": ("run examples/arm.yaml", 0.9),
    "two_vehicles": (
        "compare examples/two_vehicles.yaml --methods cbf-qp,dob-vcbf-qp",
        4.3,
    ),
    "quadrotor_slalom": ("run examples/quadrotor_slalom.py", 4.0),
}
FIGURES = {"yard": ("run examples/yard/yard.yaml", "paths.png")}
# Each of them leaves its own picture.
EXAMPLES = {
    "adaptive_cruise_control": (),
    "arm_beside_wall": (),
    "own_barrier": (),
    "own_plant": (),
    "read_a_log": (),
    "teleoperator": ("--scripted",),
    "tuning_study": (),
    "two_blimps": (),
}


def _run(command: str, directory: Path) -> None:
    program = [sys.executable, "-m", "vcbf_drake", *command.split()]
    subprocess.run([*program, "--out", str(directory)], cwd=ROOT, check=True)


def _photograph(page: Path, seconds: float, picture: Path) -> None:
    """What a browser shows of a replay at a time."""
    size = {"width": 1280, "height": 800, "deviceScaleFactor": 1, "mobile": False}
    with browser() as tab:
        tab.call("Emulation.setDeviceMetricsOverride", **size)
        tab.open(f"{page.as_uri()}#t={seconds}")
        clock = "document.getElementById('clock')?.innerText ?? null"
        assert tab.settle(clock).startswith(f"{seconds:.2f}")
        time.sleep(3.0)  # Meshes of files come a little later.
        data = tab.call("Page.captureScreenshot")["data"]
    picture.write_bytes(base64.b64decode(data))


def make(name: str) -> Path:
    """Makes a picture; returns its path."""
    picture = IMAGES / f"{name}.png"
    with tempfile.TemporaryDirectory() as place:
        directory = Path(place)
        if name in REPLAYS:
            command, seconds = REPLAYS[name]
            _run(command, directory)
            _photograph(directory / "replay.html", seconds, picture)
        elif name in FIGURES:
            command, figure = FIGURES[name]
            _run(command, directory)
            shutil.copy(directory / figure, picture)
        else:
            program = [sys.executable, str(ROOT / "examples" / f"{name}.py")]
            subprocess.run([*program, *EXAMPLES[name]], cwd=directory, check=True)
            shutil.copy(directory / "out" / "examples" / f"{name}.png", picture)
    assert picture.stat().st_size < MOST, f"{picture}: too large"
    return picture


if __name__ == "__main__":
    for each in sys.argv[1:] or [*REPLAYS, *FIGURES, *EXAMPLES]:
        print(make(each))
