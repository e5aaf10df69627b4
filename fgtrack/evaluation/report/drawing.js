"use strict";
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
    return this.scene.palette[index % this.scene.palette.length];
  }

  /** Sensors take the colours from the end, so that few sensors and few runs have none in common. */
  colourOfSensor(name) {
    const { palette, sensors } = this.scene;
    return palette[palette.length - 1 - (sensors.indexOf(name) % palette.length)];
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
