"use strict";
// The viewer of a report: reads its data, draws it on a canvas, and answers the controls.

/** The numbers of a column; NaN where a value is missing. */
function numbers({ step, values }) {
  return Float64Array.from(values, (value) => (value === null ? NaN : value * step));
}

/** All columns of a table by name. */
function tableOf(packed) {
  return Object.fromEntries(Object.entries(packed).map(([name, column]) => [name, numbers(column)]));
}

/** Number of values of the rising `values`[from..to) that are at most `limit`, counted from 0. */
function countUpTo(values, limit, from = 0, to = values.length) {
  while (from < to) {
    const middle = (from + to) >> 1;
    if (values[middle] <= limit) from = middle + 1;
    else to = middle;
  }
  return from;
}

/** Where the rows of each tick begin: rows of tick k are starts[k] to starts[k + 1]; both rise in time. */
function startsOfTicks(ticks, times) {
  const starts = new Int32Array(ticks.length + 1);
  let row = 0;
  for (let k = 0; k < ticks.length; k += 1) {
    while (row < times.length && times[row] < ticks[k] - 1e-9) row += 1;
    starts[k] = row;
  }
  starts[ticks.length] = times.length;
  return starts;
}

/** For every row the row before it with the same identity; -1 for the first one. */
function rowsBefore(identities) {
  const before = new Int32Array(identities.length);
  const last = new Map();
  for (let row = 0; row < identities.length; row += 1) {
    before[row] = last.get(identities[row]) ?? -1;
    last.set(identities[row], row);
  }
  return before;
}

/** Rows of each identity, in their order. */
function rowsOf(identities) {
  const rows = new Map();
  for (let row = 0; row < identities.length; row += 1) {
    if (!rows.has(identities[row])) rows.set(identities[row], []);
    rows.get(identities[row]).push(row);
  }
  return new Map([...rows].sort((a, b) => a[0] - b[0]).map(([identity, found]) => [identity, Int32Array.from(found)]));
}

/** A path through times: where something was at any time between its first and its last one. */
class Path {
  constructor(table, rows) {
    this.t = Float64Array.from(rows, (row) => table.t[row]);
    this.x = Float64Array.from(rows, (row) => table.x[row]);
    this.y = Float64Array.from(rows, (row) => table.y[row]);
    this.yaw = Float64Array.from(rows, (row) => table.yaw[row]);
    this.pause = 5 * medianStep(this.t);
  }

  /** x, y and yaw at `time`, linear between stamps; null before the first, after the last one and in a pause. */
  at(time) {
    const next = countUpTo(this.t, time);
    const row = next - 1;
    if (row < 0) return null;
    if (next === this.t.length) return time - this.t[row] <= this.pause ? this.#row(row) : null;
    const step = this.t[next] - this.t[row];
    if (step > this.pause) return time - this.t[row] <= this.pause ? this.#row(row) : null;
    const share = step > 0 ? (time - this.t[row]) / step : 0;
    const turn = Math.atan2(Math.sin(this.yaw[next] - this.yaw[row]), Math.cos(this.yaw[next] - this.yaw[row]));
    return {
      x: this.x[row] + share * (this.x[next] - this.x[row]),
      y: this.y[row] + share * (this.y[next] - this.y[row]),
      yaw: this.yaw[row] + share * turn,
    };
  }

  /** As `at`; before the first and after the last stamp, and in a pause, what is nearest before, or the first. */
  near(time) {
    if (!this.t.length) return null;
    return this.at(time) ?? this.#row(Math.max(0, countUpTo(this.t, time) - 1));
  }

  #row(row) {
    return { x: this.x[row], y: this.y[row], yaw: this.yaw[row] };
  }
}

function medianStep(times) {
  const steps = [];
  for (let k = 1; k < times.length; k += 1) if (times[k] > times[k - 1]) steps.push(times[k] - times[k - 1]);
  steps.sort((a, b) => a - b);
  return steps.length ? steps[steps.length >> 1] : 0.1;
}

/** What the runs of a recording share. */
class Recording {
  constructor(packed) {
    this.map = packed.map.map((line) => ({ kind: line.kind, x: numbers(line.x), y: numbers(line.y) }));
    const ego = tableOf(packed.ego);
    this.ego = new Path(ego, Int32Array.from(ego.t.keys()));
    const truth = tableOf(packed.truth);
    this.objects = new Map();
    for (const [object, rows] of rowsOf(truth.object)) this.objects.set(object, new Path(truth, rows));
    this.end = Math.max(this.ego.t.at(-1) ?? 0, ...truth.t.slice(-1), 0);
  }
}

/** A run, indexed by time. */
class Run {
  constructor(packed, recordings) {
    this.label = packed.label;
    this.recording = recordings[packed.recording];
    this.statuses = packed.statuses;
    this.sensors = packed.sensors;
    this.dispositions = packed.dispositions;
    this.ticks = numbers(packed.ticks);
    this.step = medianStep(this.ticks);
    this.tracks = tableOf(packed.tracks);
    this.tracksOfTick = startsOfTicks(this.ticks, this.tracks.t);
    this.trackBefore = rowsBefore(this.tracks.track);
    this.past = tableOf(packed.past);
    this.pastOfTick = startsOfTicks(this.ticks, this.past.t);
    this.final = tableOf(packed.final);
    this.finalOfTrack = rowsOf(this.final.track);
    this.detections = tableOf(packed.detections);
    const stamped = [...this.detections.stamp.keys()].filter((row) => Number.isFinite(this.detections.stamp[row]));
    this.byStamp = Int32Array.from(stamped).sort(
      (a, b) => this.detections.stamp[a] - this.detections.stamp[b] || a - b,
    );
    this.stamps = Float64Array.from(this.byStamp, (row) => this.detections.stamp[row]);
    this.end = Math.max(this.recording.end, this.ticks.at(-1) ?? 0, this.detections.receipt.at(-1) ?? 0);
  }

  /** Number of the newest tick at `time`; -1 before the first one. */
  tickAt(time) {
    return countUpTo(this.ticks, time + 1e-9) - 1;
  }

  /** First and behind-last row of the tracks at tick `tick`. */
  trackRows(tick) {
    return tick < 0 ? [0, 0] : [this.tracksOfTick[tick], this.tracksOfTick[tick + 1]];
  }

  /** Row of the track that is nearest to a place at `tick`, with its distance; null where there is none. */
  nearest(tick, place) {
    const [from, to] = this.trackRows(tick);
    let found = null;
    for (let row = from; row < to; row += 1) {
      const distance = Math.hypot(this.tracks.x[row] - place.x, this.tracks.y[row] - place.y);
      if (found === null || distance < found.distance) found = { row, distance };
    }
    return found;
  }

  /** Row of the track with that number at `tick`; -1 where there is none. */
  rowOfTrack(tick, track) {
    const [from, to] = this.trackRows(tick);
    for (let row = from; row < to; row += 1) if (this.tracks.track[row] === track) return row;
    return -1;
  }
}

/** Everything that the viewer shows. */
function readScene(text) {
  const packed = JSON.parse(text);
  const recordings = packed.recordings.map((one) => new Recording(one));
  const runs = packed.runs.map((one) => new Run(one, recordings));
  return {
    runs,
    colours: packed.colours,
    sensorColours: packed.sensor_colours,
    moment: packed.moment,
    size: packed.size_m,
    used: new Set(packed.used),
    late: new Set(packed.late),
    sensors: [...new Set(runs.flatMap((run) => run.sensors))].sort(),
    end: Math.max(0, ...runs.map((run) => run.end)),
  };
}

// Draws one run, or several over one another, into a pane of the canvas. World: metres, y up; a pane clips it.

const MARKS = { // corners to the right and up
  circle: null,
  square: [[-1, -1], [1, -1], [1, 1], [-1, 1]],
  triangle: [[0, 1.2], [-1.1, -1], [1.1, -1]],
  diamond: [[0, 1.3], [-1.3, 0], [0, -1.3], [1.3, 0]],
};
const SENSOR_MARKS = Object.keys(MARKS);
const BEARING_M = 150;
const SHOWN_S = 0.3; // how long a detection stays
const MOST_IN_FLIGHT = 2000;
const WIDEST = 100; // pixels of a line
const CHUNK = 64; // points of a piece of the map, which is drawn only if it can be seen

/** Where a pane is on the canvas, what of the world is in its middle, and which direction points to the right. */
class Camera {
  constructor(pane, x, y, turn, scale) {
    Object.assign(this, { pane, x, y, scale });
    this.right = [scale * Math.cos(turn), scale * Math.sin(turn)];
    this.middle = [pane.left + pane.width / 2, pane.top + pane.height / 2];
  }

  /** Lets the context draw in metres from here on. */
  toWorld(context, ratio) {
    const [c, s] = this.right;
    const [left, top] = this.onCanvas(0, 0);
    context.setTransform(c * ratio, s * ratio, s * ratio, -c * ratio, left * ratio, top * ratio);
  }

  /** Place on the canvas in CSS pixels. */
  onCanvas(x, y) {
    const [c, s] = this.right;
    const [dx, dy] = [x - this.x, y - this.y];
    return [this.middle[0] + c * dx + s * dy, this.middle[1] + s * dx - c * dy];
  }

  /** Whether a place is in the pane, or not more than `margin` metres beside it. */
  sees(x, y, margin) {
    const [left, top] = this.onCanvas(x, y);
    const { pane } = this;
    const reach = margin * this.scale;
    return (
      left >= pane.left - reach && left <= pane.left + pane.width + reach &&
      top >= pane.top - reach && top <= pane.top + pane.height + reach
    );
  }

  /** Beyond which sides of the pane a place is, a bit for each: a line between two with a common one is not seen. */
  sides(x, y) {
    const [left, top] = this.onCanvas(x, y);
    const { pane } = this;
    const [right, bottom] = [pane.left + pane.width + WIDEST, pane.top + pane.height + WIDEST];
    return (left < pane.left - WIDEST) | ((left > right) << 1) | ((top < pane.top - WIDEST) << 2) | ((top > bottom) << 3);
  }
}

/** Lines of the map in pieces with their bounds. */
function piecesOfMap(map) {
  const pieces = [];
  for (const line of map) {
    for (let from = 0; from + 1 < line.x.length; from += CHUNK) {
      const to = Math.min(from + CHUNK + 1, line.x.length);
      const path = new Path2D();
      const piece = { kind: line.kind, path, x: 0, y: 0, reach: 0 };
      piece.x = line.x[from];
      piece.y = line.y[from];
      for (let k = from; k < to; k += 1) {
        path.lineTo(line.x[k], line.y[k]);
        piece.reach = Math.max(piece.reach, Math.hypot(line.x[k] - piece.x, line.y[k] - piece.y));
      }
      pieces.push(piece);
    }
  }
  return pieces;
}

/** Draws at a time; settings say what. */
class Painter {
  constructor(context, scene) {
    this.context = context;
    this.scene = scene;
    this.pieces = new Map();
    for (const run of scene.runs) {
      if (!this.pieces.has(run.recording)) this.pieces.set(run.recording, piecesOfMap(run.recording.map));
    }
  }

  colourOfRun(index) {
    return this.scene.colours[index];
  }

  colourOfSensor(name) {
    const { sensorColours, sensors } = this.scene;
    return sensorColours[sensors.indexOf(name) % sensorColours.length];
  }

  /** One pane: `runs` are numbers of runs of the same recording, over one another; detections are as of the first one. */
  pane(camera, ratio, time, runs, settings, theme) {
    const { context } = this;
    this.camera = camera;
    this.theme = theme;
    this.px = 1 / camera.scale; // metres
    context.save();
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.beginPath();
    context.rect(camera.pane.left, camera.pane.top, camera.pane.width, camera.pane.height);
    context.clip();
    camera.toWorld(context, ratio);
    context.lineJoin = "round";
    const { recording } = this.scene.runs[runs[0]];
    if (settings.map) this.#map(recording);
    if (settings.truth) this.#truth(recording, time, settings.trail);
    for (const index of runs) this.#run(index, time, settings);
    if (settings.detections !== "none") this.#detections(this.scene.runs[runs[0]], time, settings.detections);
    this.#ego(recording, time);
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    if (settings.names) for (const index of runs) this.#names(this.scene.runs[index], time);
    context.restore();
  }

  #map(recording) {
    const { context, theme, px } = this;
    for (const piece of this.pieces.get(recording)) {
      if (!this.camera.sees(piece.x, piece.y, piece.reach)) continue;
      context.strokeStyle = piece.kind === "bound" ? theme.bound : theme.grid;
      context.lineWidth = (piece.kind === "bound" ? 1.5 : 1) * px;
      context.stroke(piece.path);
    }
  }

  /** Continues the line to a place; a piece that cannot be seen is left out. */
  #lineTo(x, y, isFirst = false) {
    const sides = this.camera.sides(x, y);
    if (isFirst || (sides & this.sides) !== 0) this.context.moveTo(x, y);
    else this.context.lineTo(x, y);
    this.sides = sides;
  }

  #truth(recording, time, trail) {
    const { context, theme } = this;
    for (const path of recording.objects.values()) {
      const here = path.at(time);
      if (here === null) continue;
      context.strokeStyle = theme.truth;
      context.lineWidth = Math.max(this.scene.size[1], 4 * this.px);
      context.beginPath();
      const first = countUpTo(path.t, time - trail);
      for (let row = first; row < path.t.length && path.t[row] <= time; row += 1) {
        this.#lineTo(path.x[row], path.y[row], row === first);
      }
      this.#lineTo(here.x, here.y);
      context.stroke();
      if (this.camera.sees(here.x, here.y, 50)) this.#box(here.x, here.y, here.yaw, theme.truth, null);
    }
  }

  #run(index, time, settings) {
    const run = this.scene.runs[index];
    const tick = run.tickAt(time);
    const [from, to] = run.trackRows(tick);
    const isNew = tick >= 0 && time - run.ticks[tick] <= Math.max(1, 20 * run.step);
    const colour = this.colourOfRun(index);
    if (isNew) {
      for (let row = from; row < to; row += 1) {
        if (settings.published) this.#published(run, row, time - settings.trail, colour);
        if (settings.past) this.#past(run, tick, row, time, settings, colour);
      }
      for (let row = from; row < to; row += 1) this.#track(run, row, settings, colour);
    }
  }

  /** The positions of a track as they were published, dotted. */
  #published(run, row, since, colour) {
    const { context, px } = this;
    const { x, y, t } = run.tracks;
    context.strokeStyle = colour;
    context.globalAlpha = 0.75;
    context.lineWidth = 1.2 * px;
    context.setLineDash([2 * px, 3 * px]);
    context.beginPath();
    for (let at = row; at >= 0 && t[at] >= since; at = run.trackBefore[at]) this.#lineTo(x[at], y[at], at === row);
    context.stroke();
    context.setLineDash([]);
    context.globalAlpha = 1;
  }

  /** The past of a track as it is known now: final states, the states of every lag, the present one. */
  #past(run, tick, row, time, settings, colour) {
    const { context, px } = this;
    const { tracks, past, final } = run;
    const track = tracks.track[row];
    const ellipses = [];
    context.strokeStyle = colour;
    context.lineWidth = 2 * px;
    context.beginPath();
    const rows = run.finalOfTrack.get(track) ?? [];
    let last = -Infinity;
    for (let k = firstOfStamp(rows, final.t, time - settings.trail); k < rows.length; k += 1) {
      const at = rows[k];
      if (final.t[at] > time) break;
      if (final.known[at] > time + 1e-9) continue;
      this.#lineTo(final.x[at], final.y[at], last === -Infinity);
      last = at;
    }
    const [from, to] = [run.pastOfTick[tick], run.pastOfTick[tick + 1]];
    let known = last > -Infinity;
    for (let at = from; at < to; at += 1) {
      if (past.track[at] !== track) continue;
      this.#lineTo(past.x[at], past.y[at], !known);
      known = true;
      ellipses.push([past, at]);
    }
    if (!known) return;
    if (to > from || time - final.t[last] < 3) this.#lineTo(tracks.x[row], tracks.y[row]);
    context.stroke();
    if (!settings.ellipses) return;
    if (last > -Infinity) ellipses.push([final, last]);
    context.globalAlpha = 0.6;
    context.lineWidth = px;
    for (const [table, at] of ellipses) this.#ellipse(table, at);
    context.globalAlpha = 1;
  }

  #track(run, row, settings, colour) {
    const { context, px } = this;
    const { x, y, yaw, status } = run.tracks;
    if (!this.camera.sees(x[row], y[row], 50)) return;
    const isSure = run.statuses[status[row]] === "confirmed";
    if (settings.ellipses) {
      context.strokeStyle = colour;
      context.fillStyle = colour;
      context.lineWidth = 1.5 * px;
      this.#ellipse(run.tracks, row, 0.15);
    }
    this.#box(x[row], y[row], yaw[row], null, colour, isSure);
  }

  #ellipse(table, row, fill = 0) {
    const { context } = this;
    const [long, short] = [table.long[row], table.short[row]];
    if (!(long >= 0) || !this.camera.sees(table.x[row], table.y[row], long)) return;
    context.beginPath();
    context.ellipse(table.x[row], table.y[row], long, short, table.direction[row], 0, 2 * Math.PI);
    if (fill) {
      const alpha = context.globalAlpha;
      context.globalAlpha = fill;
      context.fill();
      context.globalAlpha = alpha;
    }
    context.stroke();
  }

  /** An object of the size of a car, at least some pixels long; its front is marked. */
  #box(x, y, yaw, fill, stroke, isSure = true) {
    const { context, px } = this;
    const grown = Math.max(1, (10 * px) / this.scene.size[0]);
    const [half, side] = [(grown * this.scene.size[0]) / 2, (grown * this.scene.size[1]) / 2];
    const [c, s] = Number.isFinite(yaw) ? [Math.cos(yaw), Math.sin(yaw)] : [1, 0];
    const corner = (ahead, left) => context.lineTo(x + c * ahead - s * left, y + s * ahead + c * left);
    context.beginPath();
    corner(-half, -side);
    corner(0.55 * half, -side);
    corner(half, 0);
    corner(0.55 * half, side);
    corner(-half, side);
    context.closePath();
    if (fill !== null) {
      context.fillStyle = fill;
      context.fill();
    }
    if (stroke !== null) {
      context.strokeStyle = stroke;
      context.lineWidth = 2 * px;
      context.setLineDash(isSure ? [] : [3 * px, 2 * px]);
      context.stroke();
      context.setLineDash([]);
    }
  }

  #ego(recording, time) {
    const here = recording.ego.at(time);
    if (here !== null && this.camera.sees(here.x, here.y, 20)) {
      this.#box(here.x, here.y, here.yaw, this.theme.ego, this.theme.text);
    }
  }

  /** Hollow from the stamp on (sensed, on its way), full from the receipt on, with a line to where its track is then. */
  #detections(run, time, mode) {
    const { detections } = run;
    if (mode !== "received") {
      const reach = mode === "stamped" ? SHOWN_S : Infinity;
      const to = countUpTo(run.stamps, time + 1e-9);
      for (let k = to - 1; k >= 0 && k > to - MOST_IN_FLIGHT && run.stamps[k] > time - reach; k -= 1) {
        const row = run.byStamp[k];
        const isOnItsWay = detections.receipt[row] > time + 1e-9;
        if (mode === "stamped") this.#detection(run, row, false, 1 - (time - run.stamps[k]) / SHOWN_S);
        else if (isOnItsWay) this.#detection(run, row, false, 1);
        else if (time - run.stamps[k] > 5) break;
      }
    }
    if (mode !== "stamped") {
      const from = countUpTo(detections.receipt, time - SHOWN_S);
      const to = countUpTo(detections.receipt, time + 1e-9);
      for (let row = from; row < to; row += 1) {
        this.#detection(run, row, true, 1 - (time - detections.receipt[row]) / (1.3 * SHOWN_S));
      }
    }
  }

  #detection(run, row, isFull, strength) {
    const { context, px, theme } = this;
    const { x, y, sensor, disposition, track_x, track_y, from_x, from_y, bearing } = run.detections;
    const name = run.dispositions[disposition[row]];
    const colour = this.scene.used.has(name) ? this.colourOfSensor(run.sensors[sensor[row]]) : theme.unused;
    context.globalAlpha = Math.max(0.15, Math.min(1, strength));
    context.strokeStyle = colour;
    context.fillStyle = colour;
    context.lineWidth = 1.5 * px;
    if (Number.isFinite(x[row])) {
      if (this.camera.sees(x[row], y[row], 100)) {
        if (isFull && Number.isFinite(track_x[row])) {
          context.lineWidth = (this.scene.late.has(name) ? 1.5 : 0.7) * px;
          context.beginPath();
          context.moveTo(x[row], y[row]);
          context.lineTo(track_x[row], track_y[row]);
          context.stroke();
          context.lineWidth = 1.5 * px;
        }
        this.#mark(x[row], y[row], this.scene.sensors.indexOf(run.sensors[sensor[row]]), isFull);
      }
    } else if (bearing !== undefined && Number.isFinite(bearing[row])) {
      context.lineWidth = px;
      context.beginPath();
      context.moveTo(from_x[row], from_y[row]);
      context.lineTo(from_x[row] + BEARING_M * Math.cos(bearing[row]), from_y[row] + BEARING_M * Math.sin(bearing[row]));
      context.stroke();
    }
    context.globalAlpha = 1;
  }

  /** A mark that stands upright however the picture is turned. */
  #mark(x, y, sensor, isFull) {
    const { context, px } = this;
    const r = 4.5 * px;
    const [c, s] = this.camera.right.map((value) => value / this.camera.scale);
    const corner = ([right, up]) => context.lineTo(x + r * (c * right - s * up), y + r * (s * right + c * up));
    const corners = MARKS[SENSOR_MARKS[sensor % SENSOR_MARKS.length]];
    context.beginPath();
    if (corners === null) context.arc(x, y, r, 0, 2 * Math.PI);
    else corners.forEach(corner);
    context.closePath();
    if (isFull) context.fill();
    context.stroke();
  }

  #names(run, time) {
    const { context, theme } = this;
    const [from, to] = run.trackRows(run.tickAt(time));
    context.font = "12px system-ui, sans-serif";
    context.fillStyle = theme.text;
    for (let row = from; row < to; row += 1) {
      const [x, y] = [run.tracks.x[row], run.tracks.y[row]];
      if (!this.camera.sees(x, y, 0)) continue;
      const [left, top] = this.camera.onCanvas(x, y);
      context.fillText(String(run.tracks.track[row]), left + 8, top - 8);
    }
  }
}

/** Place in `rows`, which are in order of their time, of the first one at `since` or later. */
function firstOfStamp(rows, times, since) {
  let [from, to] = [0, rows.length];
  while (from < to) {
    const middle = (from + to) >> 1;
    if (times[rows[middle]] < since) from = middle + 1;
    else to = middle;
  }
  return from;
}

// The strip below the picture: how far each run is off the followed object over time, and when late detections came.

const STRIP_PIXELS = 64;
const FARTHEST_M = 10; // a track that is farther away is of another object
const SHOWN_SHARE = 0.99; // of the errors; those beyond are cut off

/** Distance of the nearest track to a true object at each tick of a run; NaN where there is none. */
function errorsOf(run, object) {
  const path = run.recording.objects.get(object);
  return Float32Array.from(run.ticks, (time, tick) => {
    const place = path?.at(time) ?? null;
    const nearest = place === null ? null : run.nearest(tick, place);
    return nearest !== null && nearest.distance < FARTHEST_M ? nearest.distance : NaN;
  });
}

class Strip {
  constructor(canvas, caption, viewer) {
    this.canvas = canvas;
    this.caption = caption;
    this.viewer = viewer;
    this.context = canvas.getContext("2d");
    this.errors = new Map();
    this.curves = document.createElement("canvas"); // what does not change with time
  }

  /** Draws the time, and the curves where something else has changed. */
  draw() {
    const { canvas, context, viewer } = this;
    const [kind, id] = viewer.follow.split(" ");
    canvas.hidden = this.caption.hidden = kind !== "object";
    if (canvas.hidden) return;
    const { ratio, theme } = viewer;
    const { width } = viewer.size;
    const shows = [width, ratio, id, viewer.runsShown(), theme.background].join(" ");
    if (shows !== this.shows) {
      this.shows = shows;
      canvas.width = this.curves.width = Math.round(width * ratio);
      canvas.height = this.curves.height = Math.round(STRIP_PIXELS * ratio);
      this.#drawCurves(Number(id), width, ratio, theme);
    }
    context.drawImage(this.curves, 0, 0);
    context.fillStyle = theme.text;
    context.fillRect(Math.round(this.#at(viewer.time) * canvas.width) - ratio, 0, 2 * ratio, canvas.height);
  }

  /** Share of the width at which a time is. */
  #at(time) {
    return this.viewer.scene.end > 0 ? time / this.viewer.scene.end : 0;
  }

  #drawCurves(object, width, ratio, theme) {
    const { viewer } = this;
    const context = this.curves.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.fillStyle = theme.background;
    context.fillRect(0, 0, width, STRIP_PIXELS);
    context.fillStyle = theme.bound;
    for (const time of viewer.lateTimes) context.fillRect(this.#at(time) * width, STRIP_PIXELS - 5, 1, 5);
    const runs = viewer.runsShown();
    const every = runs.map((run) => this.#errors(run, object));
    const known = Float32Array.from(every.flatMap((errors) => [...errors]).filter(Number.isFinite)).sort();
    const top = known[Math.floor(SHOWN_SHARE * (known.length - 1))] || 1;
    for (const [k, errors] of every.entries()) {
      const { ticks } = viewer.scene.runs[runs[k]];
      context.lineWidth = Math.min(1 + 1.4 * (every.length - 1 - k), 4); // equal curves are seen below one another
      context.strokeStyle = viewer.painter.colourOfRun(runs[k]);
      context.beginPath();
      let isBroken = true;
      for (let tick = 0; tick < ticks.length; tick += 1) {
        if (Number.isFinite(errors[tick])) {
          const [x, y] = [this.#at(ticks[tick]) * width, (STRIP_PIXELS - 8) * (1 - Math.min(errors[tick] / top, 1)) + 2];
          if (isBroken) context.moveTo(x, y);
          else context.lineTo(x, y);
        }
        isBroken = !Number.isFinite(errors[tick]);
      }
      context.stroke();
    }
    this.caption.textContent =
      `Position error at object ${object}, 0 to ${top.toPrecision(2)} m; the strokes are late detections.`;
  }

  #errors(index, object) {
    const key = `${index} ${object}`;
    if (!this.errors.has(key)) this.errors.set(key, errorsOf(this.viewer.scene.runs[index], object));
    return this.errors.get(key);
  }
}

// Links to a moment: what the address says behind #, in the form t=12.34&view=-8,0,40&follow=...

/** The link to what `viewer` shows. */
function linkTo(viewer) {
  const { view, settings } = viewer;
  const said = new URLSearchParams({
    t: viewer.time.toFixed(4).replace(/\.?0+$/, ""),
    view: [view.x, view.y, view.width].map((value) => Number(value.toFixed(2))).join(","),
    follow: viewer.follow,
    turn: viewer.isTurned ? "travel" : "north",
    layout: viewer.isSideBySide ? "side" : "over",
    runs: viewer.runsShown().join(","),
    detections: settings.detections,
    layers: LAYERS.filter((layer) => settings[layer]).join(","),
  });
  return `#${said.toString().replaceAll("%2C", ",")}`;
}

/** Lets `viewer` show what `link` says; gives whether it names a moment. What it does not say stays as it is. */
function showLink(viewer, link) {
  const said = new URLSearchParams(link.slice(1));
  if (!said.has("t")) return false;
  const oneOf = (name, ...choices) => (choices.includes(said.get(name)) ? said.get(name) : undefined);
  const { settings, scene } = viewer;
  viewer.isSideBySide = (oneOf("layout", "side", "over") ?? (viewer.isSideBySide ? "side" : "over")) === "side";
  viewer.isTurned = (oneOf("turn", "travel", "north") ?? (viewer.isTurned ? "travel" : "north")) === "travel";
  viewer.follow = oneOf("follow", ...viewer.controls.followed()) ?? viewer.follow;
  settings.detections = oneOf("detections", "both", "received", "stamped", "none") ?? settings.detections;
  const runs = (said.get("runs") ?? "").split(",").filter((run) => run !== "" && scene.runs[run] !== undefined);
  if (runs.length) viewer.shown = new Set(runs.map(Number));
  const [x, y, width] = (said.get("view") ?? "").split(",").map(Number);
  if ([x, y, width].every(Number.isFinite) && width > 0) viewer.view = { x, y, width: widthWithin(width) };
  if (said.has("layers")) {
    const layers = said.get("layers").split(",");
    for (const layer of LAYERS) settings[layer] = layers.includes(layer);
  }
  viewer.isPlaying = false;
  viewer.seek(Number(said.get("t")));
  return true;
}

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
    this.follow = this.#firstFollowed();
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

  /** The object, or else the track, that the moment of the report is about; without one the first that there is. */
  #firstFollowed() {
    const { moment, runs } = this.scene;
    const followed = this.controls.followed();
    if (moment === null) return followed[0];
    const places = [...runs[0].recording.objects].map(([object, path]) => [`object ${object}`, path.at(moment.t)]);
    const nearest = runs[0].nearest(runs[0].tickAt(moment.t), moment);
    if (!places.length && nearest) places.push([`track ${runs[0].tracks.track[nearest.row]}`, moment]);
    const away = (place) => (place ? Math.hypot(place.x - moment.x, place.y - moment.y) : Infinity);
    places.sort((a, b) => away(a[1]) - away(b[1]));
    return places.length && followed.includes(places[0][0]) ? places[0][0] : followed[0];
  }

  /** The moment that the report is about; without one a late detection a little after the first track. */
  #firstTime() {
    if (this.scene.moment !== null) return this.scene.moment.t;
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

const viewer = new Viewer(document.getElementById("viewer"), readScene(document.getElementById("scene").textContent));
