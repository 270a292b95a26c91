// Line charts that share the time axis and its cursor; a click or a drag seeks.

const SVG = "http://www.w3.org/2000/svg";
const MARGIN = { left: 42, right: 10, top: 6, bottom: 30 };

function element(name, attributes, parent) {
  const node = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  if (parent) parent.appendChild(node);
  return node;
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

/** The least and the greatest value of a plot, 0 included, with some room. */
function rangeOf(runs, key) {
  const values = runs.flatMap((run) => run[key].filter((value) => value !== null));
  const low = Math.min(0, ...values);
  const high = Math.max(0, ...values) || (low < 0 ? 0 : 1);
  const room = 0.06 * (high - low);
  return [low - room, high + room];
}

class Plot {
  constructor(container, plot, data, seek) {
    const figure = container.appendChild(document.createElement("figure"));
    const caption = figure.appendChild(document.createElement("figcaption"));
    caption.textContent = plot.title + " ";
    caption.appendChild(document.createElement("small")).textContent = plot.note;
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
    const [low, high] = rangeOf(this.data.runs, this.plot.key);
    this.x = (t) => MARGIN.left + (t / this.data.duration) * (this.right - MARGIN.left);
    this.y = (v) => bottom + ((v - low) / (high - low)) * (MARGIN.top - bottom);
    this.svg.replaceChildren();
    this.svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    this.drawAxes(low, high, bottom);
    this.drawCurves(bottom);
    this.cursor = element(
      "line", { class: "cursor", y1: MARGIN.top, y2: bottom }, this.svg,
    );
    this.dots = this.data.runs.map((run) =>
      element("circle", { r: 3.5, fill: run.color, class: "stop" }, this.svg));
  }

  drawAxes(low, high, bottom) {
    const left = MARGIN.left;
    const zero = this.y(0);
    if (this.plot.below) {
      const size = { x: left, y: zero, width: this.right - left, height: bottom - zero };
      element("rect", { class: "below", ...size }, this.svg);
    }
    for (const value of ticks(low, high, 4)) {
      const y = this.y(value);
      const name = value === 0 ? "zero" : "grid";
      element("line", { class: name, x1: left, x2: this.right, y1: y, y2: y }, this.svg);
      const place = { x: left - 6, y: y + 4, "text-anchor": "end" };
      element("text", place, this.svg).textContent = value;
    }
    for (const value of ticks(0, this.data.duration, 6)) {
      const place = { x: this.x(value), y: bottom + 14, "text-anchor": "middle" };
      element("text", place, this.svg).textContent = value;
    }
    const place = { x: (left + this.right) / 2, y: bottom + 27, "text-anchor": "middle" };
    element("text", place, this.svg).textContent = "time [s]";
  }

  /** Every curve twice: pale as a whole, and strong up to the cursor. */
  drawCurves(bottom) {
    const clip = element("clipPath", { id: `past-${this.plot.key}` }, this.svg);
    this.past = element("rect", { x: 0, y: 0, height: bottom + MARGIN.bottom }, clip);
    const ahead = element("g", { class: "ahead" }, this.svg);
    const past = element("g", { "clip-path": `url(#past-${this.plot.key})` }, this.svg);
    for (const run of this.data.runs) {
      const d = pathThrough(run.time, run[this.plot.key], this.x, this.y);
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
    this.data.runs.forEach((run, index) => {
      const k = lastIndexUpTo(run.time, time);
      const value = run[this.plot.key][k];
      this.dots[index].setAttribute("visibility", value === null ? "hidden" : "visible");
      this.dots[index].setAttribute("cx", this.x(Math.min(time, run.time.at(-1))));
      this.dots[index].setAttribute("cy", value === null ? 0 : this.y(value));
    });
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
