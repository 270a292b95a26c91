// The clock of the page: it plays, seeks, and tells the scene and the plots the time.

const data = JSON.parse(document.getElementById("replay-data").textContent);
data.primary = data.runs.at(-1); // What the camera follows and the inputs are shown of.
const byId = (name) => document.getElementById(name);
const pane = byId("meshcat-pane");
const scene = new ReplayScene(data, pane, byId("labels"));
const plots = [
  ...data.plots.map((plot) => new Plot(byId("plots"), plot, data, seek)),
  ...(data.plots.length ? [new Choice(byId("plots"), data)] : []),
];
const icons = {
  play: '<svg width="12" height="14"><path d="M0 0L12 7L0 14Z" fill="currentColor"/></svg>',
  pause: '<svg width="12" height="14"><path d="M0 0h4v14h-4zM8 0h4v14h-4z" fill="currentColor"/></svg>',
};

let time = 0;
let playing = false;
let lastFrame = null; // When the last frame was drawn [ms].

function fillLegend() {
  for (const run of [...data.runs].reverse()) {
    const item = byId("legend").appendChild(document.createElement("li"));
    item.title = "Bring this one out";
    item.addEventListener("click", () => setPrimary(run));
    run.item = item;
    const swatch = item.appendChild(element("svg", { width: 30, height: 10 }));
    element("line", {
      x1: 1, x2: 29, y1: 5, y2: 5, stroke: run.color, "stroke-width": 3.2,
      "stroke-dasharray": run.dashes,
    }, swatch);
    for (const [name, text] of [["name", run.label], ["state", ""]]) {
      const cell = item.appendChild(document.createElement("span"));
      cell.className = name;
      cell.textContent = text;
      run[name + "Cell"] = cell;
    }
  }
}

/** Chooses the run that the camera follows and whose inputs are shown. */
function setPrimary(run) {
  data.primary = run;
  data.runs.forEach((each) => each.item.classList.toggle("primary", each === run));
  plots.forEach((plot) => plot.draw());
  show();
}

/** Tells the legend and the labels how every run fares at the present time. */
function tellStates() {
  const tight = data.runs.map((run) => {
    const past = run.events.filter((event) => event.time <= time + 1e-9);
    const over = time > run.time.at(-1) + 1e-9;
    const volume = run.volume?.[lastIndexUpTo(run.time, time)] ?? 0;
    const tight = !past.length && !over && volume < 0;
    const event = past.at(-1)
      ?? { kind: tight ? "tight" : "", text: tight ? "hardly any room: Vᵥ < 0" : "under way" };
    run.stateCell.textContent = event.text;
    run.stateCell.className = `state ${event.kind}`;
    return tight;
  });
  scene.mark(tight);
}

function show() {
  scene.show(time);
  plots.forEach((plot) => plot.show(time));
  tellStates();
  byId("scrubber").value = time;
  byId("clock").innerHTML =
    `${time.toFixed(2)} s <small>of ${data.duration.toFixed(1)} s</small>`;
}

function seek(to) {
  if (data.live) return; // There is nothing but the present.
  time = Math.min(Math.max(to, 0), data.duration);
  show();
}

function setPlaying(on) {
  if (data.live) fetch(on ? "go" : "pause", { method: "POST" });
  else if (on && time >= data.duration) time = 0;
  playing = on;
  byId("play").innerHTML = on ? icons.pause : icons.play;
}

/** Listens to a run that goes on, until it is over. */
function listen() {
  const stream = new EventSource("stream");
  stream.onmessage = (message) => {
    JSON.parse(message.data).forEach((news, k) => append(data.runs[k], news));
    time = data.primary.time.at(-1);
    data.frames_per_second = (data.primary.path.length - 1) / Math.max(time, 1e-6);
    plots.forEach((plot) => plot.draw());
    show();
  };
  stream.addEventListener("over", () => {
    stream.close();
    do_reconnect = false; // Meshcat's, which would wait for a server that is gone.
    document.documentElement.classList.add("over");
  });
}

/** Appends lists to lists of the same name, at any depth. */
function append(known, news) {
  for (const [name, value] of Object.entries(news)) {
    if (Array.isArray(value)) known[name].push(...value);
    else if (value instanceof Object) append(known[name], value);
  }
}

/** Folds the card or opens it, and remembers which where the browser allows it. */
function setFolded(folded, remember) {
  byId("card").classList.toggle("folded", folded);
  byId("fold").setAttribute("aria-expanded", String(!folded));
  byId("fold").textContent = folded ? "+" : "–";
  if (remember) withMemory((memory) => memory.setItem("vcbf_drake.folded", folded));
}

/** The value of a function of the browser's memory; null in a frame that has none. */
function withMemory(use) {
  try {
    return use(window.localStorage);
  } catch {
    return null;
  }
}

function setFollow(on) {
  scene.setFollow(on, time);
  byId("follow").setAttribute("aria-pressed", String(scene.follows));
}

/** Seeks to the time in the address, such as #t=4.0 or #t=4.0&follow, and stays. */
function seekToAddress() {
  const match = /[#&]t=([0-9.]+)/.exec(location.hash);
  if (!match) return false;
  setPlaying(false);
  seek(Number(match[1]));
  if (location.hash.includes("follow")) setFollow(true);
  return true;
}

function layOut() {
  if (!pane.clientWidth || !pane.clientHeight) return; // In a frame that is not shown yet.
  viewer.set_3d_pane_size();
  scene.keepFitted();
  plots.forEach((plot) => plot.draw());
  show();
}

function onFrame(now) {
  requestAnimationFrame(onFrame);
  // A page that was out of sight goes on from where it was.
  const elapsed = lastFrame === null ? 0 : Math.min((now - lastFrame) / 1000, 0.5);
  lastFrame = now;
  if (playing && !data.live) {
    time = Math.min(time + Number(byId("speed").value) * elapsed, data.duration);
    if (time >= data.duration) setPlaying(false);
    viewer.set_dirty();
  }
  scene.keepFitted();
  scene.placeLabels(time);
}

// Meshcat's objects, recording and camera arrive after this script has run, in any order
// and as late as they like. Whenever something has changed the picture, it is drawn with
// what belongs to the present time, never before.
let stale = true;
const [setDirty, render] = [viewer.set_dirty.bind(viewer), viewer.render.bind(viewer)];
viewer.set_dirty = () => {
  stale = true;
  setDirty();
};
viewer.render = () => {
  if (stale) show();
  stale = false;
  render();
};

const KEYS = {
  " ": () => setPlaying(!playing),
  ArrowLeft: () => seek(time - 0.5),
  ArrowRight: () => seek(time + 0.5),
  f: () => setFollow(!scene.follows),
  r: () => setFollow(false),
  c: () => byId("fold").click(),
};

fillLegend();
data.primary.item.classList.add("primary");
document.documentElement.classList.toggle("bare", !data.plots.length);
const folded = withMemory((memory) => memory.getItem("vcbf_drake.folded"));
const small = window.innerWidth < 1400 || window.innerHeight < 760;
setFolded(folded === null ? small : folded === "true", false);
byId("fold").addEventListener("click", () =>
  setFolded(!byId("card").classList.contains("folded"), true));
byId("scrubber").max = data.duration;
byId("scrubber").addEventListener("input", (event) => seek(Number(event.target.value)));
byId("play").addEventListener("click", () => setPlaying(!playing));
byId("follow").addEventListener("click", () => setFollow(!scene.follows));
byId("reset").addEventListener("click", () => setFollow(false));
window.addEventListener("keydown", (event) => {
  if (!(event.key in KEYS) || event.ctrlKey || event.metaKey || event.altKey) return;
  event.preventDefault();
  KEYS[event.key]();
});
new ResizeObserver(layOut).observe(pane);
window.addEventListener("hashchange", seekToAddress);
layOut();
const calm = window.matchMedia("(prefers-reduced-motion: reduce)").matches;
document.documentElement.classList.toggle("live", Boolean(data.live));
document.documentElement.classList.toggle("driven", Boolean(data.sliders));
if (data.live) listen();
if (data.sliders) viewer.gui.open();
if (!seekToAddress()) setPlaying(data.live || !calm);
requestAnimationFrame(onFrame);
