"use strict";
// Plays the runs of a report on a canvas. The state consists of the form's controls and the view.

const BEARING_M = 150; // length of a drawn line of sight
const SHOWN_S = 0.3; // display time of a received detection
const TRAIL_S = 2;
const WIDTHS_M = [4, 20000];
const FIRST_WIDTH_M = { ego: 160, other: 40 }; // initial widths; larger around the ego, whose opponents are far away
const BEHIND = 0.2; // shift of the picture as a share of its width: it shows more behind the followed object
const FARTHEST_M = 10; // largest distance between a track and its object
const STRIP_PX = 64;
const PANES = { leastPx: 300, most: 3 }; // least width and largest number of panes side by side
const LINK_MS = 300; // delay before the address is updated
const MARKS = {
  "\u25CF": null,
  "\u25A0": [[-1, -1], [1, -1], [1, 1], [-1, 1]],
  "\u25B2": [[0, -1.2], [-1.1, 1], [1.1, 1]],
  "\u25C6": [[0, -1.3], [-1.3, 0], [0, 1.3], [1.3, 0]],
}; // corners of the marks, to the right and down

// --- Data ------------------------------------------------------------------------------------------------------------

/** Columns of a table; NaN for a missing value. */
function tableOf(columns) {
  const column = ([name, values]) => [name, Float64Array.from(values, (value) => value ?? NaN)];
  return Object.fromEntries(Object.entries(columns).map(column));
}

/** Number of values at most `limit` among the `length` ascending values at(0), at(1) ... */
function countUpTo(length, limit, at) {
  let [from, to] = [0, length];
  while (from < to) {
    const middle = (from + to) >> 1;
    if (at(middle) <= limit) from = middle + 1;
    else to = middle;
  }
  return from;
}

/** The rows after `since` and up to `until`; `rows` are in order of time. */
function between(rows, times, since, until) {
  const count = (limit) => countUpTo(rows.length, limit, (k) => times[rows[k]]);
  return rows.slice(count(since), count(until + 1e-9));
}

/** Rows of each value of a column, by ascending value. */
function rowsOf(values) {
  const rows = new Map([...new Set(values)].sort((a, b) => a - b).map((value) => [value, []]));
  values.forEach((value, row) => rows.get(value).push(row));
  return rows;
}

/** Median of the positive steps between times. */
function usualStep(times) {
  const steps = times.slice(1).map((time, k) => time - times[k]).filter((step) => step > 0).sort();
  return steps.length ? steps[steps.length >> 1] : 0.1;
}

/** A path through rows of a table: the pose at any time between the first and the last row. */
class Path {
  constructor(table, rows = [...table.t.keys()]) {
    Object.assign(this, { table, rows, t: Float64Array.from(rows, (row) => table.t[row]) });
    this.pause = 5 * usualStep(this.t);
  }

  /** x, y and yaw at `time`, linear between stamps; null before the first stamp, after the last one, and in a pause. */
  at(time) {
    const { x, y, yaw } = this.table;
    const next = countUpTo(this.t.length, time, (k) => this.t[k]);
    if (!next) return null;
    const [since, step] = [time - this.t[next - 1], (this.t[next] ?? Infinity) - this.t[next - 1]];
    const [a, b] = [this.rows[next - 1], this.rows[next]];
    if (step > this.pause) return since <= this.pause ? { x: x[a], y: y[a], yaw: yaw[a] } : null;
    const share = step > 0 ? since / step : 0;
    const turn = Math.atan2(Math.sin(yaw[b] - yaw[a]), Math.cos(yaw[b] - yaw[a]));
    return { x: x[a] + share * (x[b] - x[a]), y: y[a] + share * (y[b] - y[a]), yaw: yaw[a] + share * turn };
  }

  /** As `at`; instead of null the last row before `time`, or the first row. null for an empty path. */
  near(time) {
    if (!this.t.length) return null;
    return this.at(time) ?? this.at(this.t[Math.max(0, countUpTo(this.t.length, time, (k) => this.t[k]) - 1)]);
  }
}

/** A run, indexed by time. */
class Run {
  constructor(packed, colour, recordings) {
    Object.assign(this, packed, { colour, recording: recordings[packed.recording], errors: new Map() });
    this.ticks = Float64Array.from(packed.ticks);
    for (const name of ["tracks", "past", "final", "detections"]) this[name] = tableOf(packed[name]);
    this.step = usualStep(this.ticks);
    this.trackPaths = new Map([...rowsOf(this.tracks.track)].map(([id, rows]) => [id, new Path(this.tracks, rows)]));
    this.tracksOfTick = rowsOf(this.tracks.t);
    this.pastOfTick = rowsOf(this.past.t);
    this.finalOfTrack = rowsOf(this.final.track);
    const { stamp, receipt } = this.detections;
    this.byReceipt = [...receipt.keys()];
    this.byStamp = this.byReceipt.filter((row) => Number.isFinite(stamp[row])).sort((a, b) => stamp[a] - stamp[b]);
    this.longestDelay = this.byStamp.reduce((most, row) => Math.max(most, receipt[row] - stamp[row]), 0);
    this.end = Math.max(this.recording.end, this.ticks.at(-1) ?? 0, receipt.at(-1) ?? 0);
  }

  /** Newest tick at `time`, and its rows of tracks and of lagged states. */
  at(time) {
    const tick = this.ticks[countUpTo(this.ticks.length, time + 1e-9, (k) => this.ticks[k]) - 1];
    return { tick, rows: this.tracksOfTick.get(tick) ?? [], past: this.pastOfTick.get(tick) ?? [] };
  }

  /** Row and distance of the track nearest to a position at `time`; undefined without tracks. */
  nearest(time, place) {
    const { x, y } = this.tracks;
    const found = this.at(time).rows.map((row) => ({ row, distance: Math.hypot(x[row] - place.x, y[row] - place.y) }));
    return found.sort((a, b) => a.distance - b.distance)[0];
  }

  /** Distance of the nearest track from a true object at each tick; NaN without a track or truth. */
  errorsAt(object) {
    if (!this.errors.has(object)) {
      const path = this.recording.objects.get(object);
      this.errors.set(object, Float32Array.from(this.ticks, (tick) => {
        const place = path?.at(tick);
        const distance = place ? this.nearest(tick, place)?.distance : NaN;
        return distance < FARTHEST_M ? distance : NaN;
      }));
    }
    return this.errors.get(object);
  }
}

function readScene(text) {
  const scene = JSON.parse(text);
  for (const recording of scene.recordings) {
    recording.ego = new Path(tableOf(recording.ego));
    const truth = tableOf(recording.truth);
    recording.objects = new Map([...rowsOf(truth.object)].map(([object, rows]) => [object, new Path(truth, rows)]));
    recording.end = Math.max(0, recording.ego.t.at(-1) ?? 0, truth.t.at(-1) ?? 0);
  }
  scene.runs = scene.runs.map((run, k) => new Run(run, scene.colours[k], scene.recordings));
  scene.sensors = [...new Set(scene.runs.flatMap((run) => run.sensors))].sort();
  scene.end = Math.max(0, ...scene.runs.map((run) => run.end));
  const late = ({ receipt, fate }) => receipt.filter((time, row) => fate[row] === 2);
  scene.lateTimes = [...new Set(scene.runs.flatMap((run) => [...late(run.detections)]))].sort((a, b) => a - b);
  return scene;
}

// --- Drawing ---------------------------------------------------------------------------------------------------------

/** Part of the canvas that shows runs of one recording; it draws the detections of the first run. */
class Pane {
  constructor(viewer, runs, box) {
    Object.assign(this, { viewer, runs, ...box, context: viewer.context, theme: viewer.theme, scene: viewer.scene });
    const { x, y, turn } = viewer.middle(runs[0]);
    this.scale = this.width / viewer.view.width;
    Object.assign(this, { x, y, turn, c: this.scale * Math.cos(turn), s: this.scale * Math.sin(turn) });
  }

  /** Canvas position [CSS pixels] of a map position [m]. */
  at(x, y) {
    const [dx, dy] = [x - this.x, y - this.y];
    const [left, top] = [this.left + this.width / 2, this.top + this.height / 2];
    return [left + this.c * dx + this.s * dy, top + this.s * dx - this.c * dy];
  }

  draw(time, shows, detections) {
    const { context, runs } = this;
    const { recording } = runs[0];
    context.save();
    context.beginPath();
    context.rect(this.left, this.top, this.width, this.height);
    context.clip();
    context.lineJoin = "round";
    if (shows.has("map")) for (const line of recording.map) this.mapLine(line);
    if (shows.has("truth")) for (const path of recording.objects.values()) this.truth(path, time);
    for (const run of runs) this.run(run, time, shows);
    if (detections !== "none") this.detections(runs[0], time, detections);
    const ego = recording.ego.at(time);
    if (ego) this.box(ego, this.theme.ego, this.theme.text);
    if (shows.has("names")) for (const run of runs) this.names(run, time);
    this.title(time);
    context.restore();
  }

  /** Draws a line through map positions. */
  line(places, colour, width, dash = [], alpha = 1) {
    const { context } = this;
    context.globalAlpha = alpha;
    context.strokeStyle = colour;
    context.lineWidth = width;
    context.setLineDash(dash);
    context.beginPath();
    for (const [x, y] of places) context.lineTo(...this.at(x, y));
    context.stroke();
    context.setLineDash([]);
    context.globalAlpha = 1;
  }

  mapLine({ kind, x, y }) {
    const [colour, width] = kind === "bound" ? [this.theme.bound, 1.5] : [this.theme.grid, 1];
    this.line(x.map((value, k) => [value, y[k]]), colour, width);
  }

  truth(path, time) {
    const here = path.at(time);
    if (here === null) return;
    const rows = between(path.rows, path.table.t, time - TRAIL_S, time);
    const places = [...rows.map((row) => [path.table.x[row], path.table.y[row]]), [here.x, here.y]];
    this.line(places, this.theme.truth, Math.max(this.scene.size_m[1] * this.scale, 4));
    this.box(here, this.theme.truth, null);
  }

  run(run, time, shows) {
    const { tick, rows, past } = run.at(time);
    if (!(time - tick <= Math.max(1, 20 * run.step))) return; // the run has ended
    const { x, y, yaw, t, track, confirmed } = run.tracks;
    for (const row of rows) {
      const trail = between(run.trackPaths.get(track[row]).rows, t, time - TRAIL_S, time);
      const published = trail.map((each) => [x[each], y[each]]);
      if (shows.has("published")) this.line(published, run.colour, 1.2, [2, 3], 0.75);
      if (shows.has("past")) this.past(run, row, past, time, shows);
    }
    for (const row of rows) {
      if (shows.has("ellipses")) this.ellipse(run.tracks, row, run.colour, 1.5, 0.15, 1);
      this.box({ x: x[row], y: y[row], yaw: yaw[row] }, null, run.colour, confirmed[row] ? [] : [3, 2]);
    }
  }

  /** Draws the past of a track as estimated at this time: final, lagged and present states. */
  past(run, row, pastRows, time, shows) {
    const { tracks, past, final } = run;
    const ended = between(run.finalOfTrack.get(tracks.track[row]) ?? [], final.t, time - TRAIL_S, time);
    const known = ended.filter((each) => final.known[each] <= time + 1e-9).map((each) => [final, each]);
    const lagged = pastRows.filter((each) => past.track[each] === tracks.track[row]).map((each) => [past, each]);
    if (!known.length && !lagged.length) return;
    const places = [...known, ...lagged, [tracks, row]].map(([table, each]) => [table.x[each], table.y[each]]);
    this.line(places, run.colour, 2);
    if (!shows.has("ellipses")) return;
    for (const [table, each] of [...lagged, ...known.slice(-1)]) this.ellipse(table, each, run.colour, 1, 0, 0.6);
  }

  ellipse(table, row, colour, width, fill, alpha) {
    const { context, scale } = this;
    const [long, short] = [table.long[row] * scale, table.short[row] * scale];
    if (!(long >= 0)) return;
    context.beginPath();
    context.ellipse(...this.at(table.x[row], table.y[row]), long, short, this.turn - table.direction[row], 0, 2 * Math.PI);
    Object.assign(context, { fillStyle: colour, strokeStyle: colour, lineWidth: width, globalAlpha: fill });
    context.fill();
    context.globalAlpha = alpha;
    context.stroke();
    context.globalAlpha = 1;
  }

  /** Draws an object of a car's size, at least ten pixels long, with a pointed front. */
  box(place, fill, stroke, dash = []) {
    const { context, scene, turn } = this;
    const scale = Math.max(this.scale, 10 / scene.size_m[0]);
    const [half, side] = scene.size_m.map((size) => (scale * size) / 2);
    const angle = (Number.isFinite(place.yaw) ? place.yaw : 0) - turn;
    const [c, s] = [Math.cos(angle), Math.sin(angle)];
    const [left, top] = this.at(place.x, place.y);
    context.beginPath();
    for (const [ahead, aside] of [[-half, -side], [0.55 * half, -side], [half, 0], [0.55 * half, side], [-half, side]]) {
      context.lineTo(left + c * ahead - s * aside, top - s * ahead - c * aside);
    }
    context.closePath();
    Object.assign(context, { fillStyle: fill, strokeStyle: stroke, lineWidth: 2 });
    context.setLineDash(dash);
    if (fill !== null) context.fill();
    if (stroke !== null) context.stroke();
    context.setLineDash([]);
  }

  /** Draws detections: hollow from the stamp on, full from the receipt on, then with a line to the track. */
  detections(run, time, mode) {
    const { stamp, receipt } = run.detections;
    if (mode === "stamped") {
      for (const row of between(run.byStamp, stamp, time - SHOWN_S, time)) {
        this.detection(run, row, false, 1 - (time - stamp[row]) / SHOWN_S);
      }
      return;
    }
    const measured = mode === "both" ? between(run.byStamp, stamp, time - run.longestDelay - 1e-6, time) : [];
    for (const row of measured) if (receipt[row] > time + 1e-9) this.detection(run, row, false, 1);
    for (const row of between(run.byReceipt, receipt, time - SHOWN_S, time)) {
      this.detection(run, row, true, 1 - (time - receipt[row]) / (1.3 * SHOWN_S));
    }
  }

  detection(run, row, isFull, strength) {
    const { x, y, sensor, fate, track_x, track_y, from_x, from_y, bearing } = run.detections;
    const index = this.scene.sensors.indexOf(run.sensors[sensor[row]]);
    const colour = fate[row] ? this.viewer.colourOfSensor(index) : this.theme.unused;
    const alpha = Math.max(0.15, Math.min(1, strength));
    if (Number.isFinite(x[row])) {
      const places = [[x[row], y[row]], [track_x[row], track_y[row]]];
      if (isFull && Number.isFinite(track_x[row])) this.line(places, colour, fate[row] === 2 ? 1.5 : 0.7, [], alpha);
      this.mark(x[row], y[row], index, colour, isFull, alpha);
    } else if (Number.isFinite(bearing[row])) {
      const end = [from_x[row] + BEARING_M * Math.cos(bearing[row]), from_y[row] + BEARING_M * Math.sin(bearing[row])];
      this.line([[from_x[row], from_y[row]], end], colour, 1, [], alpha);
    }
  }

  mark(x, y, sensor, colour, isFull, alpha) {
    const { context } = this;
    const [left, top] = this.at(x, y);
    const corners = Object.values(MARKS)[sensor % 4];
    Object.assign(context, { fillStyle: colour, strokeStyle: colour, lineWidth: 1.5, globalAlpha: alpha });
    context.beginPath();
    if (corners === null) context.arc(left, top, 4.5, 0, 2 * Math.PI);
    else for (const [right, down] of corners) context.lineTo(left + 4.5 * right, top + 4.5 * down);
    context.closePath();
    if (isFull) context.fill();
    context.stroke();
    context.globalAlpha = 1;
  }

  names(run, time) {
    const { context } = this;
    Object.assign(context, { font: "12px system-ui, sans-serif", fillStyle: this.theme.text });
    for (const row of run.at(time).rows) {
      const [left, top] = this.at(run.tracks.x[row], run.tracks.y[row]);
      context.fillText(String(run.tracks.track[row]), left + 8, top - 8);
    }
  }

  /** Draws the frame, and the names of the runs with their errors at the followed object. */
  title(time) {
    const { context, theme } = this;
    Object.assign(context, { strokeStyle: theme.grid, lineWidth: 1, font: "600 13px system-ui, sans-serif" });
    context.strokeRect(this.left + 0.5, this.top + 0.5, this.width - 1, this.height - 1);
    for (const [k, run] of this.runs.entries()) {
      const place = run.recording.objects.get(this.viewer.object)?.at(time);
      const distance = place ? run.nearest(time, place)?.distance : NaN;
      const error = place ? (distance < FARTHEST_M ? `: ${distance.toFixed(2)} m off` : ": no track") : "";
      const where = [`${run.label}${error}`, this.left + 24, this.top + 20 + 18 * k, this.width - 32];
      Object.assign(context, { lineWidth: 4, strokeStyle: theme.background, fillStyle: theme.text });
      context.strokeText(...where);
      context.fillText(...where);
      context.fillStyle = run.colour;
      context.fillRect(this.left + 8, this.top + 10 + 18 * k, 11, 11);
    }
  }

  scaleBar() {
    const { context, theme } = this;
    const most = this.viewer.view.width / 2.5;
    const unit = 10 ** Math.floor(Math.log10(most));
    const length = [5, 2, 1].map((k) => k * unit).find((each) => each <= most);
    const [left, top, right] = [this.left + 10, this.top + this.height - 12, this.left + 10 + length * this.scale];
    Object.assign(context, { strokeStyle: theme.text, fillStyle: theme.text, lineWidth: 2 });
    context.beginPath();
    for (const [x, y] of [[left, top - 5], [left, top], [right, top], [right, top - 5]]) context.lineTo(x, y);
    context.stroke();
    context.font = "12px system-ui, sans-serif";
    context.fillText(`${length} m`, left + 5, top - 6);
  }
}

/** Draws the errors of the runs at a true object over time, with strokes at late detections. */
function drawStrip(viewer) {
  const { strip, scene, ratio, theme, size, object } = viewer;
  const caption = viewer.form.querySelector(".caption");
  strip.hidden = caption.hidden = object === null;
  if (strip.hidden) return;
  const context = strip.getContext("2d");
  strip.width = Math.round(size.width * ratio);
  strip.height = Math.round(STRIP_PX * ratio);
  context.scale(ratio, ratio);
  context.fillStyle = theme.background;
  context.fillRect(0, 0, size.width, STRIP_PX);
  const at = (time) => (scene.end > 0 ? (time / scene.end) * size.width : 0);
  context.fillStyle = theme.bound;
  for (const time of scene.lateTimes) context.fillRect(at(time), STRIP_PX - 5, 1, 5);
  const runs = viewer.shown();
  const known = Float32Array.from(runs.flatMap((run) => [...run.errorsAt(object)].filter(Number.isFinite))).sort();
  const highest = known[Math.floor(0.99 * (known.length - 1))] || 1; // 99 % quantile: higher errors are cut off
  for (const [k, run] of runs.entries()) {
    const errors = run.errorsAt(object);
    const every = Math.max(1, Math.floor(errors.length / (2 * size.width)));
    context.strokeStyle = run.colour;
    context.lineWidth = Math.min(1 + 1.4 * (runs.length - 1 - k), 4); // wider lines below, so that equal curves remain visible
    context.beginPath();
    for (let tick = 0, isBroken = true; tick < errors.length; tick += every) {
      const place = [at(run.ticks[tick]), (STRIP_PX - 8) * (1 - Math.min(errors[tick] / highest, 1)) + 2];
      if (!Number.isNaN(errors[tick])) isBroken ? context.moveTo(...place) : context.lineTo(...place);
      isBroken = Number.isNaN(errors[tick]);
    }
    context.stroke();
  }
  context.fillStyle = theme.text;
  context.fillRect(at(viewer.time) - 1, 0, 2, STRIP_PX);
  caption.textContent = `Position error at object ${object}, 0 to ${highest.toPrecision(2)} m; the strokes are late detections.`;
}

// --- The viewer ------------------------------------------------------------------------------------------------------

class Viewer {
  constructor(form, scene) {
    Object.assign(this, { form, scene, isPlaying: false, isUsed: false, controls: form.elements });
    this.canvas = form.querySelector("#stage canvas");
    this.context = this.canvas.getContext("2d");
    this.strip = form.querySelector(".strip");
    this.fillControls();
    this.begin();
    this.readTheme();
    this.listen();
    if (this.showLink(location.hash)) form.scrollIntoView();
    this.resize();
  }

  // --- state

  get time() {
    return Number(this.controls.t.value);
  }

  get follow() {
    return this.controls.follow.value;
  }

  /** The followed true object; null if anything else is followed. */
  get object() {
    return this.follow.startsWith("object ") ? Number(this.follow.slice(7)) : null;
  }

  /** Values of the checked boxes with this name. */
  checked(name) {
    return [...this.form.querySelectorAll(`[name=${name}]:checked`)].map((box) => box.value);
  }

  shown() {
    return this.checked("run").map((index) => this.scene.runs[index]);
  }

  seek(time) {
    this.controls.t.value = String(Math.min(Math.max(0, time || 0), this.scene.end));
    this.changed();
  }

  play(isPlaying) {
    if (isPlaying && this.time >= this.scene.end) this.seek(0);
    Object.assign(this, { isPlaying, before: null });
    this.changed();
  }

  step(seconds) {
    this.play(false);
    this.seek(Math.round((this.time + seconds) * 1e4) / 1e4);
  }

  /** Moves to the next receipt of an out-of-sequence detection; with -1 to the previous one. */
  toLate(direction) {
    const { lateTimes } = this.scene;
    const count = countUpTo(lateTimes.length, this.time + direction * 1e-6, (k) => lateTimes[k]);
    this.play(false);
    this.seek(lateTimes[direction > 0 ? count : count - 1] ?? this.time);
  }

  /** Zooms about the followed object; about the middle of the picture if nothing is followed. */
  zoom(factor) {
    const width = Math.min(Math.max(this.view.width * factor, WIDTHS_M[0]), WIDTHS_M[1]);
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

  /** Resets the view: the offset of the picture's middle from the followed object, and its width, in metres. */
  resetView(width = FIRST_WIDTH_M[this.follow] ?? FIRST_WIDTH_M.other) {
    const isBehind = this.controls.turn.value === "travel" && this.follow !== "ego" && this.follow !== "nothing";
    this.view = { x: isBehind ? -BEHIND * width : 0, y: 0, width };
    this.changed();
  }

  /** Map position in the middle of a pane of `run`, and the direction that points to the right. */
  middle(run = this.shown()[0]) {
    const target = this.target(run);
    const turn = this.controls.turn.value === "travel" && Number.isFinite(target.yaw) ? target.yaw : 0;
    const [c, s] = [Math.cos(turn), Math.sin(turn)];
    return { x: target.x + c * this.view.x - s * this.view.y, y: target.y + s * this.view.x + c * this.view.y, turn };
  }

  /** Pose of the followed object at this time, in the recording of `run`. */
  target({ recording }) {
    const id = Number(this.follow.split(" ")[1]);
    // Equal numbers belong to different objects in other runs, so all panes follow the position in the first run.
    const track = this.scene.runs[0].recording === recording ? this.scene.runs[0].trackPaths.get(id) : undefined;
    const path = { ego: recording.ego, object: recording.objects.get(id), track };
    return path[this.follow.split(" ")[0]]?.near(this.time) ?? { x: 0, y: 0 };
  }

  /** Starts at the moment of the report, and follows its object or track; without a moment at an early late detection. */
  begin() {
    const { moment, runs, lateTimes } = this.scene;
    const first = Math.min(...runs.map((run) => run.tracks.t[0] ?? Infinity));
    const later = lateTimes.find((time) => time > first + 2) ?? first + 2;
    this.controls.t.value = String(moment?.t ?? (Number.isFinite(later) ? later : 0));
    if (moment !== null) {
      const places = [...runs[0].recording.objects].map(([id, path]) => [`object ${id}`, path.at(moment.t)]);
      const nearest = runs[0].nearest(moment.t, moment);
      if (!places.length && nearest) places.push([`track ${runs[0].tracks.track[nearest.row]}`, moment]);
      const away = ([, place]) => (place ? Math.hypot(place.x - moment.x, place.y - moment.y) : Infinity);
      places.sort((a, b) => away(a) - away(b));
      this.choose("follow", places[0]?.[0]);
    }
    this.resetView();
  }

  /** Chooses an option; a missing option changes nothing. */
  choose(name, value) {
    const options = [...this.controls[name].options].map((option) => option.value);
    if (options.includes(value)) this.controls[name].value = value;
  }

  // --- the picture

  /** Number of panes that fit side by side. */
  columns() {
    return Math.min(Math.max(1, Math.floor(this.form.clientWidth / PANES.leastPx)), PANES.most);
  }

  /** Runs of each pane: a single run, or all runs of a recording. */
  groups() {
    const runs = this.shown();
    if (this.controls.layout.value === "side") return runs.map((run) => [run]);
    const recordings = [...new Set(runs.map((run) => run.recording))];
    return recordings.map((recording) => runs.filter((run) => run.recording === recording));
  }

  panes() {
    const groups = this.groups();
    const columns = Math.min(groups.length, this.columns());
    const [width, height] = [this.size.width / columns, this.size.height / Math.ceil(groups.length / columns)];
    const box = (k) => ({ left: (k % columns) * width, top: Math.floor(k / columns) * height, width, height });
    return groups.map((runs, k) => new Pane(this, runs, box(k)));
  }

  colourOfSensor(index) {
    return this.scene.sensor_colours[index % this.scene.sensor_colours.length];
  }

  /** Requests drawing with the next frame. */
  changed() {
    this.frame ??= requestAnimationFrame((now) => this.onFrame(now));
  }

  onFrame(now) {
    this.frame = undefined;
    if (this.isPlaying) {
      if (this.before !== null) this.seek(this.time + ((now - this.before) / 1000) * this.controls.speed.value);
      this.before = now;
      this.isPlaying = this.time < this.scene.end;
      this.changed();
    }
    this.draw();
  }

  draw() {
    const { context, ratio, size, controls, time } = this;
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.fillStyle = this.theme.background;
    context.fillRect(0, 0, size.width, size.height);
    const [panes, shows] = [this.panes(), new Set(this.checked("show"))];
    for (const pane of panes) pane.draw(time, shows, controls.detections.value);
    if (panes.length) this.centre = { x: panes[0].x, y: panes[0].y };
    panes[0]?.scaleBar();
    drawStrip(this);
    controls.t.setAttribute("aria-valuetext", `${time.toFixed(2)} s`);
    this.form.querySelector("output").textContent = `${time.toFixed(2)} s of ${this.scene.end.toFixed(1)} s`;
    this.form.querySelector("#play").textContent = this.isPlaying ? "Pause" : "Play";
    clearTimeout(this.linking);
    if (this.isUsed && !this.isPlaying) this.linking = setTimeout(() => this.writeLink(), LINK_MS);
  }

  /** Fits the canvas to the page. */
  resize() {
    const width = this.form.querySelector("#stage").clientWidth;
    const count = this.groups().length;
    const columns = Math.min(count, this.columns());
    const rows = Math.ceil(count / columns);
    const each = rows > 1 ? Math.max(200, 460 / rows) : Math.min(460, Math.max(280, (0.8 * width) / columns));
    this.ratio = Math.min(devicePixelRatio || 1, 2);
    this.size = { width, height: Math.round(each * rows) };
    this.canvas.style.height = `${this.size.height}px`;
    this.canvas.width = Math.round(width * this.ratio);
    this.canvas.height = Math.round(this.size.height * this.ratio);
    this.draw();
  }

  /** Reads the colours of the page. */
  readTheme() {
    const style = getComputedStyle(this.form);
    const names = ["background", "text", "grid", "bound", "truth", "ego", "unused"];
    this.theme = Object.fromEntries(names.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
  }

  // --- links: #t=12.34&view=-8,0,40&follow=..., the controls and the view

  link() {
    const settings = new URLSearchParams(new FormData(this.form));
    settings.set("t", String(Number(this.time.toFixed(4))));
    settings.set("view", [this.view.x, this.view.y, this.view.width].map((value) => Number(value.toFixed(2))).join(","));
    return `#${settings.toString().replaceAll("%2C", ",")}`;
  }

  /** Applies the settings of `link`; returns true if it contains a time. Missing settings stay unchanged. */
  showLink(link) {
    const settings = new URLSearchParams(link.slice(1));
    if (!settings.has("t")) return false;
    for (const name of ["speed", "follow", "turn", "layout", "detections"]) this.choose(name, settings.get(name));
    for (const name of ["show", "run"]) {
      const values = new Set(settings.getAll(name));
      const boxes = [...this.form.querySelectorAll(`[name=${name}]`)];
      if (boxes.some((box) => values.has(box.value))) for (const box of boxes) box.checked = values.has(box.value);
    }
    this.resetView();
    const [x, y, width] = (settings.get("view") ?? "").split(",").map(Number);
    if ([x, y, width].every(Number.isFinite) && width > 0) this.view = { x, y, width };
    this.zoom(1); // apply the limits
    this.play(false);
    this.seek(Number(settings.get("t")));
    return true;
  }

  writeLink() {
    if (this.link() !== location.hash) history.replaceState(null, "", this.link());
  }

  async copyLink({ target }) {
    this.writeLink();
    const isCopied = await navigator.clipboard?.writeText(location.href).then(() => true, () => false);
    target.textContent = isCopied ? "Link copied" : "Link is in the address bar";
  }

  // --- controls

  fillControls() {
    const { scene, controls, form } = this;
    const add = (value, text = value) => controls.follow.add(new Option(text, value));
    controls.t.max = String(scene.end);
    const objects = new Set(scene.runs.flatMap((run) => [...run.recording.objects.keys()]));
    for (const object of [...objects].sort((a, b) => a - b)) add(`object ${object}`);
    if (scene.recordings.some((recording) => recording.ego.t.length)) add("ego", "the ego");
    const longest = [...scene.runs[0].trackPaths].sort((a, b) => b[1].t.length - a[1].t.length).slice(0, 8);
    for (const [track] of longest) add(`track ${track}`);
    add("nothing");
    const isFirst = (index) => index < Math.max(2, this.columns());
    for (const [index, run] of scene.runs.entries()) {
      const label = document.createElement("label");
      const box = { type: "checkbox", name: "run", value: String(index), checked: isFirst(index) };
      const patch = Object.assign(document.createElement("span"), { className: "patch" });
      patch.style.background = run.colour;
      label.append(Object.assign(document.createElement("input"), box), patch, run.label);
      form.querySelector("#runs").append(label);
    }
    for (const [index, sensor] of scene.sensors.entries()) {
      const [entry, mark] = [document.createElement("span"), document.createElement("b")];
      mark.textContent = Object.keys(MARKS)[index % 4];
      mark.style.color = this.colourOfSensor(index);
      entry.append(mark, ` ${sensor}`);
      form.querySelector("#legend").append(entry);
    }
  }

  /** Action of a key or button. */
  action(name, isLong = false) {
    const tick = isLong ? 1 : this.scene.runs[0].step;
    const speed = (by) => {
      const { options, selectedIndex } = this.controls.speed;
      this.controls.speed.selectedIndex = Math.min(Math.max(selectedIndex + by, 0), options.length - 1);
    };
    return {
      " ": () => this.play(!this.isPlaying),
      ArrowLeft: () => this.step(-tick),
      ArrowRight: () => this.step(tick),
      ArrowUp: () => speed(1),
      ArrowDown: () => speed(-1),
      Home: () => this.step(-Infinity),
      End: () => this.step(Infinity),
      ",": () => this.toLate(-1),
      ".": () => this.toLate(1),
      "+": () => this.zoom(1 / 1.5),
      "-": () => this.zoom(1.5),
      0: () => this.resetView(),
    }[name];
  }

  /** Connects the controls. */
  listen() {
    const { form, canvas, strip, controls } = this;
    const on = (part, event, does) => part.addEventListener(event, (given) => {
      does(given);
      this.isUsed = true;
      this.changed();
    });
    form.addEventListener("submit", (event) => event.preventDefault());
    on(form, "click", (event) => this.action(event.target.dataset.do)?.());
    on(form.querySelector("#copy"), "click", (event) => this.copyLink(event));
    on(controls.t, "input", () => this.play(false));
    on(form, "change", ({ target }) => {
      if (target.name === "run" && !this.shown().length) target.checked = true;
      if (target.name === "follow" && this.follow === "nothing") this.view = { ...this.centre, width: this.view.width };
      else if (target.name === "follow") this.resetView();
      if (target.name === "turn" && this.follow !== "nothing") this.resetView(this.view.width);
      this.resize();
    });
    on(form, "keydown", (event) => {
      const { key, target } = event;
      if (event.ctrlKey || event.metaKey || event.altKey || target.tagName === "SELECT") return;
      if (key === " " && (target.tagName === "BUTTON" || target.type === "checkbox")) return;
      const does = key.length === 1 || /^(Arrow|Home$|End$)/.test(key) ? this.action(key, event.shiftKey) : undefined;
      if (does) event.preventDefault();
      does?.();
    });
    on(canvas, "wheel", (event) => {
      if (!event.ctrlKey && !event.metaKey && document.activeElement !== canvas) return;
      event.preventDefault();
      this.zoom(Math.exp(event.deltaY / 500));
    });
    this.listenToPointers();
    const seek = (event) => {
      if (!event.buttons) return;
      this.play(false);
      this.seek((event.offsetX / strip.clientWidth) * this.scene.end);
    };
    on(strip, "pointerdown", (event) => { strip.setPointerCapture(event.pointerId); seek(event); });
    on(strip, "pointermove", seek);
    addEventListener("hashchange", () => this.showLink(location.hash) && this.resize());
    new ResizeObserver(() => this.resize()).observe(form.querySelector("#stage"));
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { this.readTheme(); this.changed(); });
  }

  /** Moves the picture by one or two pointers, and zooms by the distance of two. */
  listenToPointers() {
    const [{ canvas }, held] = [this, new Map()];
    canvas.addEventListener("pointerdown", (event) => {
      canvas.focus({ preventScroll: true });
      canvas.setPointerCapture(event.pointerId);
      held.set(event.pointerId, [event.clientX, event.clientY]);
    });
    canvas.addEventListener("pointermove", (event) => {
      const from = held.get(event.pointerId);
      if (from === undefined) return;
      const to = [event.clientX, event.clientY];
      const other = [...held].find(([id]) => id !== event.pointerId)?.[1];
      this.isUsed = true;
      this.pan((to[0] - from[0]) / held.size, (to[1] - from[1]) / held.size);
      const apart = (place) => Math.max(1, Math.hypot(place[0] - other[0], place[1] - other[1]));
      if (other) this.zoom(apart(from) / apart(to));
      held.set(event.pointerId, to);
    });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, ({ pointerId }) => held.delete(pointerId));
  }
}

const viewer = new Viewer(document.getElementById("viewer"), readScene(document.getElementById("scene").textContent));
