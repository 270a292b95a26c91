// The feasible set of the present tick in the plane of two inputs: what the filter may
// choose from, the largest ellipsoid inside, the reference, and the choice.

class Choice {
  constructor(container, data) {
    this.data = data;
    const figure = container.appendChild(document.createElement("figure"));
    this.figure = figure;
    const caption = figure.appendChild(document.createElement("figcaption"));
    caption.innerHTML = "Feasible inputs <small>○ reference ● choice</small>";
    const attributes = { role: "img", "aria-label": "Feasible inputs" };
    this.svg = figure.appendChild(element("svg", attributes));
  }

  /** Draws everything but the sets for the present size. */
  draw() {
    const { width, height } = this.svg.getBoundingClientRect();
    const { names, low, high, note } = this.data.primary.axes;
    this.figure.title =
      `The set, the largest ellipsoid in it, the reference and the choice${note}`;
    this.runs = alike(this.data);
    const [left, right, top, bottom] = [52, width - 6, 5, height - 29];
    const room = [0, 1].map((axis) => 0.16 * (high[axis] - low[axis]) || 1);
    const scale = (axis, from, to) => (value) =>
      from + ((value - low[axis] + room[axis]) / (high[axis] - low[axis] + 2 * room[axis]))
      * (to - from);
    this.x = scale(0, left, right);
    this.y = scale(1, bottom, top);
    this.box = { left, right, top, bottom };
    this.svg.replaceChildren();
    this.svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    const clip = element("clipPath", { id: "choice-pane" }, this.svg);
    element("rect", { x: left, y: top, width: right - left, height: bottom - top }, clip);
    element("rect", {
      class: "limits", x: this.x(low[0]), y: this.y(high[1]),
      width: this.x(high[0]) - this.x(low[0]), height: this.y(low[1]) - this.y(high[1]),
    }, this.svg);
    for (const value of [low[0], high[0]]) {
      const place = { x: this.x(value), y: bottom + 13, "text-anchor": "middle" };
      element("text", place, this.svg).textContent = short(value);
    }
    const below = { x: (left + right) / 2, y: bottom + 24, "text-anchor": "middle" };
    element("text", below, this.svg).textContent = names[0];
    for (const value of names[1] ? [low[1], high[1]] : []) {
      const place = { x: left - 4, y: this.y(value) + 4, "text-anchor": "end" };
      element("text", place, this.svg).textContent = short(value);
    }
    const beside = `translate(${left - 42} ${(top + bottom) / 2}) rotate(-90)`;
    element("text", { transform: beside, "text-anchor": "middle" }, this.svg)
      .textContent = names[1];
    this.pane = element("g", { "clip-path": "url(#choice-pane)" }, this.svg);
    this.shown = null;
  }

  /** Draws the sets of a time [s]. */
  show(time) {
    if (!this.pane) return; // A page in a frame that is not shown has no size yet.
    const ticks = this.runs.map((run) => lastIndexUpTo(run.sets.time, time));
    if (ticks.join() === this.shown) return;
    this.shown = ticks.join();
    this.pane.replaceChildren();
    this.runs.forEach((run, index) =>
      this.drawSet(run, run.sets, ticks[index], run === this.data.primary));
  }

  drawSet(run, sets, k, primary) {
    const group = element("g", { class: primary ? "primary" : "other", stroke: run.color }, this.pane);
    const outline = sets.outline[k];
    if (outline.length) {
      const points = [];
      for (let j = 0; j < outline.length; j += 2) {
        points.push(`${this.x(outline[j]).toFixed(1)},${this.y(outline[j + 1]).toFixed(1)}`);
      }
      const style = { class: "set", points: points.join(" "), fill: run.color };
      if (!primary) style["stroke-dasharray"] = run.dashes;
      element("polygon", style, group);
    } else {
      // The chosen run's word stands in the middle, the others' in the corner.
      const { left, right, top, bottom } = this.box;
      const place = primary
        ? { x: (left + right) / 2, y: (top + bottom) / 2 + 4, "text-anchor": "middle" }
        : { x: left + 3, y: bottom - 4 - 12 * this.runs.indexOf(run) };
      const word = sets.eased[k] ? "faster decay" : "empty";
      element("text", { class: "empty", ...place, style: primary ? "" : `fill: ${run.color}` }, group)
        .textContent = primary ? word : `${run.label}: ${word}`;
    }
    if (primary && sets.ellipse[k]) this.drawEllipse(sets.ellipse[k], group);
    this.drawChoice(run, sets, k, primary, group);
  }

  drawEllipse([x, y, a, b, c], group) {
    const points = Array.from({ length: 49 }, (_, j) => {
      const angle = (j * Math.PI) / 24;
      const [u, v] = [Math.cos(angle), Math.sin(angle)];
      return `${this.x(x + a * u).toFixed(1)},${this.y(y + b * u + c * v).toFixed(1)}`;
    });
    element("polyline", { class: "ellipse", points: points.join(" ") }, group);
  }

  /** The reference, at the edge where it is out of view, and the input chosen for it. */
  drawChoice(run, sets, k, primary, group) {
    const { left, right, top, bottom } = this.box;
    const within = (value, low, high) => Math.min(Math.max(value, low + 4), high - 4);
    const [chosenX, chosenY] = [this.x(sets.input[k][0]), this.y(sets.input[k][1])];
    if (primary && sets.reference[k]) {
      const x = within(this.x(sets.reference[k][0]), left, right);
      const y = within(this.y(sets.reference[k][1]), top, bottom);
      element("line", { class: "way", x1: x, y1: y, x2: chosenX, y2: chosenY }, group);
      element("circle", { class: "reference", cx: x, cy: y, r: 4 }, group);
    }
    if (!sets.outline[k].length && !sets.eased[k]) return;
    const style = { class: "stop", cx: chosenX, cy: chosenY, fill: run.color };
    element("circle", { ...style, r: primary ? 4.5 : 3 }, group);
  }
}
