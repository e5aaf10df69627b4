"use strict";
// The viewer: its state, playing, panes. What it shows is in data.js, how it looks in drawing.js.

const LAYERS = ["map", "truth", "published", "past", "ellipses", "names"];
const FIRST_WIDTH_M = 40;
const WIDTH_OF_EGO_M = 160; // when the ego is followed: its opponents are farther away
const BEHIND = 0.2; // of the width: more of the picture is behind what is followed than ahead of it
const WIDTHS_M = [4, 20000];
const PANE_PIXELS = [300, 3]; // the least width of panes beside one another, and the largest number of them

function widthWithin(metres) {
  return Math.min(Math.max(metres, WIDTHS_M[0]), WIDTHS_M[1]);
}

class Viewer {
  constructor(root, scene) {
    this.root = root;
    this.scene = scene;
    this.canvas = root.querySelector("canvas");
    this.painter = new Painter(this.canvas.getContext("2d"), scene);
    this.time = 0;
    this.speed = 0.25;
    this.isPlaying = false;
    this.isSideBySide = true;
    this.shown = new Set([...scene.runs.keys()].slice(0, Math.max(2, this.#columns())));
    this.settings = { detections: "both", trail: 2 };
    for (const layer of LAYERS) this.settings[layer] = true;
    this.isTurned = true;
    this.frames = 0;
    this.drawnMs = 0;
    this.lateTimes = this.#lateTimes();
    this.controls = new Controls(this);
    [this.follow] = this.controls.followed();
    this.view = this.#firstView();
    this.time = this.#firstTime();
    this.strip = new Strip(this.controls.parts.strip, this.controls.parts.strip_caption, this);
    this.readTheme();
    this.controls.listen();
    if (showLink(this, location.hash)) root.scrollIntoView();
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

  /** What is followed stays where it is in the picture; when nothing is, the middle does. */
  zoom(factor) {
    const width = widthWithin(this.view.width * factor);
    const share = this.follow === "nothing" ? 1 : width / this.view.width;
    this.view = { x: this.view.x * share, y: this.view.y * share, width };
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
    const middle = this.#middle();
    this.follow = follow;
    this.view = follow === "nothing" ? { x: middle.x, y: middle.y, width: this.view.width } : this.#firstView();
    this.changed();
  }

  setTurned(isTurned) {
    this.isTurned = isTurned;
    this.view = this.follow === "nothing" ? this.view : this.#firstView(this.view.width);
    this.changed();
  }

  resetView() {
    this.view = this.#firstView();
    this.changed();
  }

  /** Numbers of the runs that are shown, rising. */
  runsShown() {
    return [...this.shown].sort((a, b) => a - b);
  }

  /** Metres to the right of and above what is followed at which the middle is, and the width of a picture. */
  #firstView(width = this.follow === "ego" ? WIDTH_OF_EGO_M : FIRST_WIDTH_M) {
    return { x: this.isTurned && this.follow !== "ego" ? -BEHIND * width : 0, y: 0, width };
  }

  /** What is in the middle of a pane of `runs`, and the direction that points to the right. */
  #middle(runs = undefined) {
    const target = this.#target(runs);
    const turn = this.isTurned && Number.isFinite(target.yaw) ? target.yaw : 0;
    const [c, s] = [Math.cos(turn), Math.sin(turn)];
    return { x: target.x + c * this.view.x - s * this.view.y, y: target.y + s * this.view.x + c * this.view.y, turn };
  }

  /** How many panes have room beside one another. */
  #columns() {
    const [least, most] = PANE_PIXELS;
    return Math.min(Math.max(1, Math.floor(this.root.clientWidth / least)), most);
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
    const shown = this.runsShown();
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
      const { x, y, turn } = this.#middle(pane.runs);
      const camera = new Camera(pane, x, y, turn, pane.width / this.view.width);
      this.painter.pane(camera, ratio, this.time, pane.runs, this.settings, theme);
      this.#frameOf(pane);
    }
    if (panes.length) this.#scaleBar(panes[0]);
    this.strip.draw();
    this.controls.show();
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

  /** Where what is followed is at this time, in the recording of the first of `runs`. */
  #target(runs = this.runsShown()) {
    const run = this.scene.runs[runs[0] ?? 0];
    const [kind, id] = this.follow.split(" ");
    let place = null;
    if (kind === "ego") place = run.recording.ego.near(this.time);
    if (kind === "object") place = run.recording.objects.get(Number(id))?.near(this.time) ?? null;
    if (kind === "track") {
      const row = run.rowOfTrack(run.tickAt(this.time), Number(id));
      if (row >= 0) place = { x: run.tracks.x[row], y: run.tracks.y[row], yaw: run.tracks.yaw[row] };
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

  /** A late detection a little after the first track: there is something to see. */
  #firstTime() {
    const first = Math.min(...this.scene.runs.map((run) => run.tracks.t[0] ?? Infinity));
    if (!Number.isFinite(first)) return 0;
    return this.lateTimes[countUpTo(this.lateTimes, first + 2)] ?? Math.min(first + 2, this.scene.end);
  }

  /** Fits the canvas to the page. */
  resize() {
    const width = this.controls.parts.stage.clientWidth;
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

  /** Takes the colours of the page. */
  readTheme() {
    const style = getComputedStyle(this.root);
    const names = ["background", "text", "grid", "bound", "truth", "ego", "unused"];
    this.theme = Object.fromEntries(names.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
  }
}

let viewer;
if (typeof DecompressionStream === "undefined") {
  document.getElementById("viewer").textContent = "This browser cannot play the runs: any of 2023 or later can.";
} else {
  readScene(document.getElementById("scene").textContent).then((scene) => {
    viewer = new Viewer(document.getElementById("viewer"), scene);
  });
}
