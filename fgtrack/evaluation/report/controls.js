"use strict";
// The controls of the viewer: buttons, keys, pointers, and what they show.

const SPEEDS = [0.05, 0.1, 0.25, 0.5, 1, 2, 4];
const LINK_MS = 300; // after which the address follows

class Controls {
  constructor(viewer) {
    this.viewer = viewer;
    this.parts = Object.fromEntries(
      [...viewer.root.querySelectorAll("[data-part]")].map((part) => [part.dataset.part, part]),
    );
    this.isUsed = false; // until then the address stays as it is
    this.#fill();
  }

  /** What can be followed. */
  followed() {
    return [...this.parts.follow.options].map((option) => option.value);
  }

  /** Shows the state of the viewer. */
  show() {
    const { parts, viewer } = this;
    const text = `${viewer.time.toFixed(2)} s`;
    parts.scrubber.value = String(viewer.time);
    parts.scrubber.setAttribute("aria-valuetext", text);
    parts.time.textContent = `${text} of ${viewer.scene.end.toFixed(1)} s`;
    parts.play.textContent = viewer.isPlaying ? "Pause" : "Play";
    parts.speed.value = String(viewer.speed);
    parts.turn.value = viewer.isTurned ? "travel" : "north";
    parts.layout.value = viewer.isSideBySide ? "side" : "over";
    parts.follow.value = viewer.follow;
    parts.detections.value = viewer.settings.detections;
    for (const layer of LAYERS) parts[layer].checked = viewer.settings[layer];
    for (const box of parts.runs.querySelectorAll("input")) box.checked = viewer.shown.has(Number(box.value));
    if (!viewer.isPlaying) {
      clearTimeout(this.linking);
      if (this.isUsed) this.linking = setTimeout(() => this.#writeLink(), LINK_MS);
    }
  }

  async #copyLink() {
    this.#writeLink();
    const { copy } = this.parts;
    try {
      await navigator.clipboard.writeText(location.href);
      copy.textContent = "Copied";
    } catch {
      copy.textContent = "It is in the address bar";
    }
    setTimeout(() => { copy.textContent = "Link to this moment"; }, 2000);
  }

  #writeLink() {
    const link = linkTo(this.viewer);
    if (link !== location.hash) history.replaceState(null, "", link);
  }

  #fill() {
    const { parts } = this;
    const { scene, painter } = this.viewer;
    parts.scrubber.max = String(scene.end);
    for (const speed of SPEEDS) parts.speed.add(new Option(`${speed} x`, String(speed)));
    const objects = [...new Set(scene.runs.flatMap((run) => [...run.recording.objects.keys()]))].sort((a, b) => a - b);
    for (const object of objects) parts.follow.add(new Option(`object ${object}`, `object ${object}`));
    if (scene.runs.some((run) => run.recording.ego.t.length)) parts.follow.add(new Option("the ego", "ego"));
    for (const track of this.#longestTracks()) parts.follow.add(new Option(`track ${track}`, `track ${track}`));
    parts.follow.add(new Option("nothing", "nothing"));
    for (const [index, run] of scene.runs.entries()) {
      const label = document.createElement("label");
      const box = Object.assign(document.createElement("input"), { type: "checkbox", value: String(index) });
      const patch = document.createElement("span");
      patch.className = "patch";
      patch.style.background = painter.colourOfRun(index);
      label.append(box, patch, run.label);
      parts.runs.append(label);
    }
    for (const sensor of scene.sensors) parts.legend.append(this.#legendOf(sensor));
    if (!scene.runs.some((run) => run.past.t.length || run.final.t.length)) parts.past.disabled = true;
  }

  #legendOf(sensor) {
    const { scene, painter } = this.viewer;
    const entry = document.createElement("span");
    const marks = { circle: "\u25CF", square: "\u25A0", triangle: "\u25B2", diamond: "\u25C6" };
    const mark = document.createElement("b");
    mark.textContent = marks[SENSOR_MARKS[scene.sensors.indexOf(sensor) % SENSOR_MARKS.length]];
    mark.style.color = painter.colourOfSensor(sensor);
    entry.append(mark, ` ${sensor}`);
    return entry;
  }

  /** Up to eight tracks of the first run that were there longest. */
  #longestTracks() {
    const counts = new Map();
    for (const track of this.viewer.scene.runs[0].tracks.track) counts.set(track, (counts.get(track) ?? 0) + 1);
    return [...counts].sort((a, b) => b[1] - a[1] || a[0] - b[0]).slice(0, 8).map(([track]) => track);
  }

  /** Lets the controls act from here on. */
  listen() {
    const { parts, viewer } = this;
    const { canvas } = viewer;
    const on = (part, event, does) => part.addEventListener(event, (...given) => {
      this.isUsed = true;
      does(...given);
      viewer.changed();
    });
    on(parts.play, "click", () => viewer.play(!viewer.isPlaying));
    on(parts.scrubber, "input", () => { viewer.isPlaying = false; viewer.seek(Number(parts.scrubber.value)); });
    on(parts.speed, "change", () => viewer.setSpeed(Number(parts.speed.value)));
    on(parts.layout, "change", () => { viewer.isSideBySide = parts.layout.value === "side"; viewer.resize(); });
    on(parts.turn, "change", () => viewer.setTurned(parts.turn.value === "travel"));
    on(parts.follow, "change", () => viewer.setFollow(parts.follow.value));
    on(parts.detections, "change", () => { viewer.settings.detections = parts.detections.value; });
    on(parts.late_before, "click", () => viewer.toLate(-1));
    on(parts.late_next, "click", () => viewer.toLate(1));
    on(parts.closer, "click", () => viewer.zoom(1 / 1.5));
    on(parts.farther, "click", () => viewer.zoom(1.5));
    on(parts.copy, "click", () => this.#copyLink());
    for (const layer of LAYERS) on(parts[layer], "change", () => { viewer.settings[layer] = parts[layer].checked; });
    on(parts.runs, "change", () => {
      const wanted = [...parts.runs.querySelectorAll("input:checked")].map((box) => Number(box.value));
      if (wanted.length) viewer.shown = new Set(wanted);
      viewer.resize();
    });
    on(viewer.root, "keydown", (event) => this.#onKey(event));
    on(canvas, "wheel", (event) => {
      if (!event.ctrlKey && !event.metaKey && document.activeElement !== canvas) return;
      event.preventDefault();
      viewer.zoom(Math.exp(event.deltaY / 500));
    });
    addPointers(canvas, (dx, dy) => { this.isUsed = true; viewer.pan(dx, dy); }, (factor) => viewer.zoom(factor));
    const seekOnStrip = (event) => {
      if (event.type === "pointermove" && !event.buttons) return;
      viewer.isPlaying = false;
      viewer.seek((event.offsetX / parts.strip.clientWidth) * viewer.scene.end);
    };
    on(parts.strip, "pointerdown", (event) => { parts.strip.setPointerCapture(event.pointerId); seekOnStrip(event); });
    on(parts.strip, "pointermove", seekOnStrip);
    addEventListener("hashchange", () => showLink(viewer, location.hash) && viewer.resize());
    new ResizeObserver(() => viewer.resize()).observe(parts.stage);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { viewer.readTheme(); viewer.changed(); });
  }

  #onKey(event) {
    const { viewer } = this;
    const { target } = event;
    if (event.ctrlKey || event.metaKey || event.altKey || target.tagName === "SELECT") return;
    if (event.key === " " && (target.tagName === "BUTTON" || target.type === "checkbox")) return;
    const does = {
      " ": () => viewer.play(!viewer.isPlaying),
      ArrowLeft: () => viewer.step(event.shiftKey ? -1 : -viewer.scene.runs[0].step),
      ArrowRight: () => viewer.step(event.shiftKey ? 1 : viewer.scene.runs[0].step),
      ArrowUp: () => this.#shiftSpeed(1),
      ArrowDown: () => this.#shiftSpeed(-1),
      Home: () => viewer.step(-Infinity),
      End: () => viewer.step(Infinity),
      ",": () => viewer.toLate(-1),
      ".": () => viewer.toLate(1),
      "+": () => viewer.zoom(1 / 1.5),
      "-": () => viewer.zoom(1.5),
      0: () => viewer.resetView(),
    }[event.key];
    if (does === undefined) return;
    event.preventDefault();
    does();
  }

  #shiftSpeed(by) {
    const place = SPEEDS.indexOf(this.viewer.speed) + by;
    this.viewer.setSpeed(SPEEDS[Math.min(Math.max(place, 0), SPEEDS.length - 1)]);
  }
}

/** Tells how far the picture is dragged, by one pointer or two, and how far two spread. */
function addPointers(canvas, onPan, onZoom) {
  const held = new Map();
  canvas.addEventListener("pointerdown", (event) => {
    canvas.focus({ preventScroll: true });
    canvas.setPointerCapture(event.pointerId);
    held.set(event.pointerId, [event.clientX, event.clientY]);
  });
  canvas.addEventListener("pointermove", (event) => {
    const from = held.get(event.pointerId);
    if (from === undefined) return;
    const others = [...held].filter(([id]) => id !== event.pointerId).map(([, place]) => place);
    const to = [event.clientX, event.clientY];
    const share = 1 / (1 + others.length);
    onPan((to[0] - from[0]) * share, (to[1] - from[1]) * share);
    if (others.length) {
      const span = (place) => Math.max(1, Math.hypot(place[0] - others[0][0], place[1] - others[0][1]));
      onZoom(span(from) / span(to));
    }
    held.set(event.pointerId, to);
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => held.delete(event.pointerId));
}
