// Line charts that share the time axis and its cursor; a click or a drag seeks.

const SVG = "http://www.w3.org/2000/svg";
const MARGIN = { left: 42, right: 10, top: 6, bottom: 30 };

function element(name, attributes, parent) {
  const node = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  if (parent) parent.appendChild(node);
  return node;
}

/** A number in at most two digits. */
function short(value) {
  return String(Number(value.toPrecision(2)));
}

/** Round numbers, at most `count` of them, that cover [low, high]. */
function ticks(low, high, count) {
  const rough = (high - low) / count;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 5, 10].find((factor) => factor * power >= rough);
  const values = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) {
    values.push(Number((k * step).toPrecision(12)));
  }
  return values;
}

/** A path through the points that lifts the pen where a value is missing. */
function pathThrough(times, values, x, y) {
  let path = "";
  let pen = "M";
  values.forEach((value, k) => {
    if (value === null) {
      pen = "M";
    } else {
      path += pen + x(times[k]).toFixed(1) + " " + y(value).toFixed(1);
      pen = "L";
    }
  });
  return path;
}

/** The runs whose inputs are those of the chosen one. */
function alike({ runs, primary }) {
  return runs.filter((run) => run.inputs.join() === primary.inputs.join());
}

/** The least and the greatest value of a lane, its limits or 0 included, with some room. */
function rangeOf(runs, { key, limits }) {
  const values = runs.flatMap((run) => run[key].filter((value) => value !== null));
  const low = Math.min(limits ? limits[0] : 0, ...values);
  const high = Math.max(limits ? limits[1] : 0, ...values) || (low < 0 ? 0 : 1);
  const room = (limits ? 0.12 : 0.06) * (high - low || 1);
  return [low - room, high + room];
}

/** One or several series over time, each in a lane of its own, above one time axis. */
class Plot {
  constructor(container, plot, data, seek) {
    const figure = container.appendChild(document.createElement("figure"));
    const caption = figure.appendChild(document.createElement("figcaption"));
    caption.textContent = plot.title + " ";
    caption.appendChild(document.createElement("small")).textContent = plot.note;
    caption.title = plot.note;
    this.svg = figure.appendChild(element("svg", { role: "img", "aria-label": plot.title }));
    this.plot = plot;
    this.data = data;
    const follow = (event) => {
      if (event.buttons !== 1) return;
      const box = this.svg.getBoundingClientRect();
      seek(this.timeAt(event.clientX - box.left));
    };
    this.svg.addEventListener("pointerdown", (event) => {
      this.svg.setPointerCapture(event.pointerId);
      follow(event);
    });
    this.svg.addEventListener("pointermove", follow);
  }

  /** What is drawn in lanes of their own: every input of the chosen run, or one series. */
  lanes() {
    if (this.plot.key !== "input") return [{ key: this.plot.key, name: "", limits: null }];
    const { inputs, limits } = this.data.primary;
    return inputs.map((name, k) => ({ key: `input${k}`, name, limits: limits[k] }));
  }

  /** The time under a horizontal place [pixels]. */
  timeAt(pixel) {
    const fraction = (pixel - MARGIN.left) / (this.right - MARGIN.left);
    return Math.min(Math.max(fraction, 0), 1) * this.data.duration;
  }

  /** Draws everything but the cursor for the present size. */
  draw() {
    const { width, height } = this.svg.getBoundingClientRect();
    this.right = width - MARGIN.right;
    const bottom = height - MARGIN.bottom;
    this.x = (t) => MARGIN.left + (t / this.data.duration) * (this.right - MARGIN.left);
    this.svg.replaceChildren();
    this.svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    const clip = element("clipPath", { id: `past-${this.plot.key}` }, this.svg);
    this.past = element("rect", { x: 0, y: 0, height }, clip);
    const lanes = this.lanes();
    this.runs = this.plot.key === "input" ? alike(this.data) : this.data.runs;
    const count = lanes.length;
    const gap = count > 1 ? 5 : 0;
    const share = (bottom - MARGIN.top + gap) / count;
    this.dots = lanes.map((lane, k) => {
      const top = MARGIN.top + k * share;
      return this.drawLane(lane, top, top + share - gap);
    });
    for (const value of ticks(0, this.data.duration, 6)) {
      const place = { x: this.x(value), y: bottom + 14, "text-anchor": "middle" };
      element("text", place, this.svg).textContent = value;
    }
    const place = { x: (MARGIN.left + this.right) / 2, y: bottom + 27, "text-anchor": "middle" };
    element("text", place, this.svg).textContent = "time [s]";
    this.cursor = element(
      "line", { class: "cursor", y1: MARGIN.top, y2: bottom }, this.svg,
    );
    for (const dot of this.dots.flat()) this.svg.appendChild(dot.node);
  }

  /** Draws a lane between two heights; its dots, one a run. */
  drawLane(lane, top, bottom) {
    const [low, high] = rangeOf(this.runs, lane);
    const y = (v) => bottom + ((v - low) / (high - low)) * (top - bottom);
    const left = MARGIN.left;
    if (this.plot.below) {
      const size = { x: left, y: y(0), width: this.right - left, height: bottom - y(0) };
      element("rect", { class: "below", ...size }, this.svg);
    }
    for (const value of lane.limits ?? ticks(low, high, 4)) {
      const name = lane.limits ? "limit" : value === 0 ? "zero" : "grid";
      const line = { class: name, x1: left, x2: this.right, y1: y(value), y2: y(value) };
      element("line", line, this.svg);
    }
    for (const [text, value] of this.numbers(lane, low, high, bottom - top)) {
      const place = { x: left - 6, y: y(value) + 4, "text-anchor": "end" };
      element("text", place, this.svg).textContent = text;
    }
    this.drawCurves(lane, y);
    if (lane.name) {
      const place = { class: "lane", x: this.right - 2, y: top + 11, "text-anchor": "end" };
      element("text", place, this.svg).textContent = lane.name;
    }
    return this.runs.map((run) => ({
      run, y, values: run[lane.key],
      node: element("circle", { r: 3.5, fill: run.color, class: "stop" }, this.svg),
    }));
  }

  /** What stands beside a lane and where: in a low one the limits share a line. */
  numbers({ limits }, low, high, height) {
    if (!limits) return ticks(low, high, 4).map((value) => [value, value]);
    if (height > 26) return limits.map((value) => [short(value), value]);
    const [least, most] = limits;
    const text = least === -most ? `±${short(most)}` : `${short(least)}..${short(most)}`;
    return [[text, 0.5 * (least + most)]];
  }

  /** Every curve twice: pale as a whole, and strong up to the cursor. */
  drawCurves(lane, y) {
    const clip = `url(#past-${this.plot.key})`;
    const ahead = element("g", { class: "ahead" }, this.svg);
    const past = element("g", { "clip-path": clip }, this.svg);
    for (const run of this.runs) {
      const d = pathThrough(run.time, run[lane.key], this.x, y);
      const style = { class: "curve", d, stroke: run.color, "stroke-dasharray": run.dashes };
      element("path", style, ahead);
      element("path", style, past);
    }
  }

  /** Moves the cursor. */
  show(time) {
    if (!this.cursor) return; // A page in a frame that is not shown has no size yet.
    const x = this.x(time);
    this.cursor.setAttribute("x1", x);
    this.cursor.setAttribute("x2", x);
    this.past.setAttribute("width", Math.max(0, x));
    for (const { run, y, values, node } of this.dots.flat()) {
      const value = values[lastIndexUpTo(run.time, time)];
      node.setAttribute("visibility", value === null ? "hidden" : "visible");
      node.setAttribute("cx", this.x(Math.min(time, run.time.at(-1))));
      node.setAttribute("cy", value === null ? 0 : y(value));
    }
  }
}

/** The index of the last of the rising `times` that is not after `time`. */
function lastIndexUpTo(times, time) {
  let low = 0;
  let high = times.length;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (times[middle] <= time + 1e-9) low = middle;
    else high = middle;
  }
  return low;
}
