"use strict";
// The viewer: state, controls, playing, links to a moment. What it shows is in data.js, how it looks in drawing.js.

const SPEEDS = [0.05, 0.1, 0.25, 0.5, 1, 2, 4];
const LAYERS = ["map", "truth", "published", "past", "ellipses", "names"];
const FIRST_WIDTH_M = 60;
const WIDTHS_M = [4, 20000];
const PANE_PIXELS = [300, 3]; // the least width of panes beside one another, and the largest number of them

class Viewer {
  constructor(root, scene) {
    this.root = root;
    this.scene = scene;
    this.canvas = root.querySelector("canvas");
    this.painter = new Painter(this.canvas.getContext("2d"), scene);
    this.parts = Object.fromEntries([...root.querySelectorAll("[data-part]")].map((part) => [part.dataset.part, part]));
    this.time = 0;
    this.speed = 0.25;
    this.isPlaying = false;
    this.isSideBySide = true;
    this.shown = new Set([...scene.runs.keys()].slice(0, Math.max(2, this.#columns())));
    this.settings = { detections: "both", trail: 2 };
    for (const layer of LAYERS) this.settings[layer] = true;
    this.view = { x: 0, y: 0, width: FIRST_WIDTH_M }; // from the object that is followed
    this.frames = 0;
    this.drawnMs = 0;
    this.lateTimes = this.#lateTimes();
    this.#fillControls();
    this.follow = this.parts.follow.value;
    this.time = this.#firstTime();
    this.#listen();
    this.#readTheme();
    this.readLink();
    this.resize();
  }

  // --- state -----------------------------------------------------------------------------------------------------

  /** Goes to a time in seconds. */
  seek(time) {
    this.time = Math.min(Math.max(0, Number.isNaN(time) ? 0 : time), this.scene.end);
    this.changed();
  }

  play(isPlaying) {
    if (isPlaying && this.time >= this.scene.end) this.time = 0;
    this.isPlaying = isPlaying;
    this.before = null;
    this.changed();
  }

  setSpeed(speed) {
    this.speed = speed;
    this.changed();
  }

  step(seconds) {
    this.play(false);
    this.seek(Math.round((this.time + seconds) * 1e4) / 1e4);
  }

  /** Goes to the next receipt of a detection out of sequence, or with -1 to the one before. */
  toLate(direction) {
    this.play(false);
    const next = countUpTo(this.lateTimes, this.time + 1e-6);
    const before = countUpTo(this.lateTimes, this.time - 1e-6) - 1;
    const found = this.lateTimes[direction > 0 ? next : before];
    if (found !== undefined) this.seek(found);
  }

  zoom(factor) {
    this.view.width = Math.min(Math.max(this.view.width * factor, WIDTHS_M[0]), WIDTHS_M[1]);
    this.changed();
  }

  pan(pixelsX, pixelsY) {
    const metres = this.view.width / this.panes()[0].width;
    this.view.x -= pixelsX * metres;
    this.view.y += pixelsY * metres;
    this.changed();
  }

  /** Follows an object, the ego, a track, or nothing; the picture stays where it is when nothing is followed. */
  setFollow(follow) {
    const from = this.#target();
    this.follow = follow;
    const to = this.#target();
    this.view.x = follow === "nothing" ? this.view.x + from.x - to.x : 0;
    this.view.y = follow === "nothing" ? this.view.y + from.y - to.y : 0;
    this.changed();
  }

  /** How many panes have room beside one another. */
  #columns() {
    const [least, most] = PANE_PIXELS;
    return Math.min(Math.max(1, Math.floor(this.root.clientWidth / least)), most);
  }

  // --- links -----------------------------------------------------------------------------------------------------

  /** What the address says behind #; a moment has the form t=12.34&view=0,0,60&follow=... */
  link() {
    const { view, settings } = this;
    const said = new URLSearchParams({
      t: this.time.toFixed(4).replace(/\.?0+$/, ""),
      view: [view.x, view.y, view.width].map((value) => Number(value.toFixed(2))).join(","),
      follow: this.follow,
      layout: this.isSideBySide ? "side" : "over",
      runs: [...this.shown].sort((a, b) => a - b).join(","),
      detections: settings.detections,
      layers: LAYERS.filter((layer) => settings[layer]).join(","),
    });
    return `#${said.toString().replaceAll("%2C", ",")}`;
  }

  /** Takes the moment over that the address names; gives whether it names one. */
  readLink() {
    const said = new URLSearchParams(location.hash.slice(1));
    if (!said.has("t")) return false;
    if (["side", "over"].includes(said.get("layout"))) this.isSideBySide = said.get("layout") === "side";
    const runs = (said.get("runs") ?? "").split(",").filter(Boolean).map(Number);
    if (runs.some((run) => this.scene.runs[run])) this.shown = new Set(runs.filter((run) => this.scene.runs[run]));
    if (said.has("follow") && [...this.parts.follow.options].some((one) => one.value === said.get("follow"))) {
      this.follow = said.get("follow");
    }
    const view = (said.get("view") ?? "").split(",").map(Number);
    if (view.length === 3 && view.every(Number.isFinite) && view[2] > 0) {
      this.view = { x: view[0], y: view[1], width: Math.min(Math.max(view[2], WIDTHS_M[0]), WIDTHS_M[1]) };
    }
    if (["both", "received", "stamped", "none"].includes(said.get("detections"))) {
      this.settings.detections = said.get("detections");
    }
    if (said.has("layers")) {
      const layers = said.get("layers").split(",");
      for (const layer of LAYERS) this.settings[layer] = layers.includes(layer);
    }
    this.isPlaying = false;
    this.seek(Number(said.get("t")));
    return true;
  }

  async copyLink() {
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
    const link = this.link();
    if (link !== location.hash) history.replaceState(null, "", link);
  }

  // --- drawing ---------------------------------------------------------------------------------------------------

  /** Draws anew with the next frame. */
  changed() {
    if (this.frame === undefined) this.frame = requestAnimationFrame((now) => this.#onFrame(now));
  }

  #onFrame(now) {
    this.frame = undefined;
    if (this.isPlaying) {
      if (this.before !== null) this.time = Math.min(this.time + ((now - this.before) / 1000) * this.speed, this.scene.end);
      this.before = now;
      if (this.time >= this.scene.end) this.isPlaying = false;
    }
    const start = performance.now();
    this.draw();
    this.drawnMs += performance.now() - start;
    this.frames += 1;
    if (this.isPlaying) this.changed();
  }

  /** Panes in CSS pixels, each with the runs that it shows. */
  panes() {
    const shown = [...this.shown].sort((a, b) => a - b);
    const groups = this.isSideBySide ? shown.map((run) => [run]) : this.#byRecording(shown);
    const { width, height } = this.size;
    const columns = Math.min(groups.length, this.#columns());
    const rows = Math.ceil(groups.length / columns);
    return groups.map((runs, k) => ({
      runs,
      left: ((k % columns) * width) / columns,
      top: (Math.floor(k / columns) * height) / rows,
      width: width / columns,
      height: height / rows,
    }));
  }

  #byRecording(runs) {
    const groups = new Map();
    for (const run of runs) {
      const { recording } = this.scene.runs[run];
      groups.set(recording, [...(groups.get(recording) ?? []), run]);
    }
    return [...groups.values()];
  }

  draw() {
    const { ratio, size, theme } = this;
    const { context } = this.painter;
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.fillStyle = theme.background;
    context.fillRect(0, 0, size.width, size.height);
    const panes = this.panes();
    for (const pane of panes) {
      const target = this.#target(pane.runs);
      const camera = new Camera(
        pane.left, pane.top, pane.width, pane.height,
        target.x + this.view.x, target.y + this.view.y, pane.width / this.view.width,
      );
      this.painter.pane(camera, ratio, this.time, pane.runs, this.settings, theme);
      this.#frameOf(pane);
    }
    if (panes.length) this.#scaleBar(panes[0]);
    this.#showState();
  }

  #frameOf(pane) {
    const { context } = this.painter;
    context.strokeStyle = this.theme.grid;
    context.lineWidth = 1;
    context.strokeRect(pane.left + 0.5, pane.top + 0.5, pane.width - 1, pane.height - 1);
    context.font = "600 13px system-ui, sans-serif";
    for (const [k, run] of pane.runs.entries()) {
      const text = `${this.scene.runs[run].label}${this.#errorOf(run)}`;
      const top = pane.top + 20 + 18 * k;
      context.lineWidth = 4;
      context.strokeStyle = this.theme.background;
      context.strokeText(text, pane.left + 24, top, pane.width - 32);
      context.fillStyle = this.theme.text;
      context.fillText(text, pane.left + 24, top, pane.width - 32);
      context.fillStyle = this.painter.colourOfRun(run);
      context.fillRect(pane.left + 8, top - 10, 11, 11);
    }
  }

  /** How far the track that is nearest to the followed object is from it. */
  #errorOf(index) {
    const run = this.scene.runs[index];
    const [kind, id] = this.follow.split(" ");
    const place = kind === "object" ? run.recording.objects.get(Number(id))?.at(this.time) : null;
    if (!place) return "";
    const nearest = run.nearest(run.tickAt(this.time), place);
    return nearest && nearest.distance < 10 ? `: ${nearest.distance.toFixed(2)} m off` : ": no track";
  }

  #scaleBar(pane) {
    const { context } = this.painter;
    const metres = 10 ** Math.floor(Math.log10(this.view.width / 2.5));
    const length = [5, 2, 1].map((k) => k * metres).find((one) => one <= this.view.width / 2.5) ?? metres;
    const pixels = (length * pane.width) / this.view.width;
    const [left, top] = [pane.left + 10, pane.top + pane.height - 12];
    context.strokeStyle = this.theme.text;
    context.fillStyle = this.theme.text;
    context.lineWidth = 2;
    context.beginPath();
    context.moveTo(left, top - 5);
    context.lineTo(left, top);
    context.lineTo(left + pixels, top);
    context.lineTo(left + pixels, top - 5);
    context.stroke();
    context.font = "12px system-ui, sans-serif";
    context.fillText(`${length} m`, left + 5, top - 6);
  }

  #showState() {
    const { parts } = this;
    const text = `${this.time.toFixed(2)} s`;
    parts.scrubber.value = String(this.time);
    parts.scrubber.setAttribute("aria-valuetext", text);
    parts.time.textContent = `${text} of ${this.scene.end.toFixed(1)} s`;
    parts.play.textContent = this.isPlaying ? "Pause" : "Play";
    parts.speed.value = String(this.speed);
    parts.layout.value = this.isSideBySide ? "side" : "over";
    parts.follow.value = this.follow;
    parts.detections.value = this.settings.detections;
    for (const layer of LAYERS) parts[layer].checked = this.settings[layer];
    for (const box of parts.runs.querySelectorAll("input")) box.checked = this.shown.has(Number(box.value));
    if (!this.isPlaying) {
      clearTimeout(this.linking);
      if (this.isUsed) this.linking = setTimeout(() => this.#writeLink(), 300);
    }
  }

  /** Where what is followed is at this time, in the recording of the first of `runs`. */
  #target(runs = [...this.shown].sort((a, b) => a - b)) {
    const run = this.scene.runs[runs[0] ?? 0];
    const [kind, id] = this.follow.split(" ");
    let place = null;
    if (kind === "ego") place = run.recording.ego.at(this.time);
    if (kind === "object") place = run.recording.objects.get(Number(id))?.at(this.time) ?? null;
    if (kind === "track") {
      const row = run.rowOfTrack(run.tickAt(this.time), Number(id));
      if (row >= 0) place = { x: run.tracks.x[row], y: run.tracks.y[row] };
    }
    this.lastTargets ??= new Map();
    if (place !== null) this.lastTargets.set(`${kind} ${id} ${runs[0]}`, place);
    return kind === "nothing" ? { x: 0, y: 0 } : place ?? this.lastTargets.get(`${kind} ${id} ${runs[0]}`) ?? { x: 0, y: 0 };
  }

  // --- setting up ------------------------------------------------------------------------------------------------

  /** Receipts of detections out of sequence, rising. */
  #lateTimes() {
    const times = new Set();
    for (const run of this.scene.runs) {
      const { receipt, disposition } = run.detections;
      for (let row = 0; row < receipt.length; row += 1) {
        if (this.scene.late.has(run.dispositions[disposition[row]])) times.add(receipt[row]);
      }
    }
    return Float64Array.from(times).sort();
  }

  /** A little after the first track: there is something to see. */
  #firstTime() {
    const first = Math.min(...this.scene.runs.map((run) => run.tracks.t[0] ?? Infinity));
    return Number.isFinite(first) ? Math.min(first + 2, this.scene.end) : 0;
  }

  #fillControls() {
    const { parts, scene } = this;
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
      patch.style.background = this.painter.colourOfRun(index);
      label.append(box, patch, run.label);
      parts.runs.append(label);
    }
    for (const sensor of scene.sensors) parts.legend.append(this.#legendOf(sensor));
    if (!scene.runs.some((run) => run.past.t.length || run.final.t.length)) parts.past.disabled = true;
  }

  #legendOf(sensor) {
    const entry = document.createElement("span");
    const marks = { circle: "\u25CF", square: "\u25A0", triangle: "\u25B2", diamond: "\u25C6" };
    const mark = document.createElement("b");
    mark.textContent = marks[SENSOR_MARKS[this.scene.sensors.indexOf(sensor) % SENSOR_MARKS.length]];
    mark.style.color = this.painter.colourOfSensor(sensor);
    entry.append(mark, ` ${sensor}`);
    return entry;
  }

  /** Up to eight tracks of the first run that were there longest. */
  #longestTracks() {
    const counts = new Map();
    for (const track of this.scene.runs[0].tracks.track) counts.set(track, (counts.get(track) ?? 0) + 1);
    return [...counts].sort((a, b) => b[1] - a[1] || a[0] - b[0]).slice(0, 8).map(([track]) => track);
  }

  #listen() {
    const { parts, canvas } = this;
    const on = (part, event, does) => part.addEventListener(event, (...given) => {
      this.isUsed = true;
      does(...given);
      this.changed();
    });
    on(parts.play, "click", () => this.play(!this.isPlaying));
    on(parts.scrubber, "input", () => { this.isPlaying = false; this.seek(Number(parts.scrubber.value)); });
    on(parts.speed, "change", () => this.setSpeed(Number(parts.speed.value)));
    on(parts.layout, "change", () => { this.isSideBySide = parts.layout.value === "side"; this.resize(); });
    on(parts.follow, "change", () => this.setFollow(parts.follow.value));
    on(parts.detections, "change", () => { this.settings.detections = parts.detections.value; });
    on(parts.late_before, "click", () => this.toLate(-1));
    on(parts.late_next, "click", () => this.toLate(1));
    on(parts.closer, "click", () => this.zoom(1 / 1.5));
    on(parts.farther, "click", () => this.zoom(1.5));
    on(parts.copy, "click", () => this.copyLink());
    for (const layer of LAYERS) on(parts[layer], "change", () => { this.settings[layer] = parts[layer].checked; });
    on(parts.runs, "change", () => {
      const wanted = [...parts.runs.querySelectorAll("input:checked")].map((box) => Number(box.value));
      if (wanted.length) this.shown = new Set(wanted);
      this.resize();
    });
    on(this.root, "keydown", (event) => this.#onKey(event));
    on(canvas, "wheel", (event) => {
      if (!event.ctrlKey && !event.metaKey && document.activeElement !== canvas) return;
      event.preventDefault();
      this.zoom(Math.exp(event.deltaY / 500));
    });
    addPointers(canvas, (dx, dy) => { this.isUsed = true; this.pan(dx, dy); }, (factor) => this.zoom(factor));
    addEventListener("hashchange", () => this.readLink() && this.resize());
    new ResizeObserver(() => this.resize()).observe(parts.stage);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { this.#readTheme(); this.changed(); });
  }

  #onKey(event) {
    const { target } = event;
    if (event.ctrlKey || event.metaKey || event.altKey || target.tagName === "SELECT") return;
    if (event.key === " " && (target.tagName === "BUTTON" || target.type === "checkbox")) return;
    const does = {
      " ": () => this.play(!this.isPlaying),
      ArrowLeft: () => this.step(event.shiftKey ? -1 : -this.scene.runs[0].step),
      ArrowRight: () => this.step(event.shiftKey ? 1 : this.scene.runs[0].step),
      ArrowUp: () => this.#shiftSpeed(1),
      ArrowDown: () => this.#shiftSpeed(-1),
      Home: () => this.step(-Infinity),
      End: () => this.step(Infinity),
      ",": () => this.toLate(-1),
      ".": () => this.toLate(1),
      "+": () => this.zoom(1 / 1.5),
      "-": () => this.zoom(1.5),
      0: () => { this.view = { x: 0, y: 0, width: FIRST_WIDTH_M }; },
    }[event.key];
    if (does === undefined) return;
    event.preventDefault();
    does();
  }

  #shiftSpeed(by) {
    const place = SPEEDS.indexOf(this.speed) + by;
    this.setSpeed(SPEEDS[Math.min(Math.max(place, 0), SPEEDS.length - 1)]);
  }

  /** Fits the canvas to the page. */
  resize() {
    const width = this.parts.stage.clientWidth;
    const groups = this.isSideBySide ? this.shown.size : this.#byRecording([...this.shown]).length;
    const columns = Math.min(groups, this.#columns());
    const rows = Math.ceil(groups / columns);
    const each = rows > 1 ? Math.max(200, 460 / rows) : Math.min(460, Math.max(280, (0.8 * width) / columns));
    this.ratio = Math.min(devicePixelRatio || 1, 2);
    this.size = { width, height: Math.round(each * rows) };
    this.canvas.style.height = `${this.size.height}px`;
    this.canvas.width = Math.round(width * this.ratio);
    this.canvas.height = Math.round(this.size.height * this.ratio);
    this.draw();
  }

  #readTheme() {
    const style = getComputedStyle(this.root);
    const names = ["background", "text", "grid", "bound", "truth", "ego", "unused"];
    this.theme = Object.fromEntries(names.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
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

const viewer = new Viewer(
  document.getElementById("viewer"),
  readScene(document.getElementById("scene").textContent),
);
