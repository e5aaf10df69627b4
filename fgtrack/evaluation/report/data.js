"use strict";
// Decodes the columns that the report embeds, and indexes them by time: see packing.py and scene.py of fgtrack.

const ARRAY_TYPES = { u8: Uint8Array, u16: Uint16Array, i16: Int16Array, i32: Int32Array, f32: Float32Array, f64: Float64Array };

/** The bytes of a deflated base64 text. */
async function inflated(base64) {
  const text = atob(base64);
  const bytes = new Uint8Array(text.length);
  for (let k = 0; k < text.length; k += 1) bytes[k] = text.charCodeAt(k);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** Typed array of bytes of which the first ones of all its numbers come first, then the second ones ... */
function arrayOf(planes, type) {
  const Type = ARRAY_TYPES[type];
  const size = Type.BYTES_PER_ELEMENT;
  const count = planes.length / size;
  const bytes = new Uint8Array(planes.length);
  for (let k = 0; k < count; k += 1) for (let b = 0; b < size; b += 1) bytes[k * size + b] = planes[b * count + k];
  return new Type(bytes.buffer);
}

/** Decodes columns; equal ones are decoded once. */
class Columns {
  /** Of the bytes of every blob. */
  constructor(blobs) {
    this.blobs = blobs;
    this.decoded = new Map();
  }

  /** The numbers of a packed column; NaN where a value is missing. */
  column(packed) {
    const key = `${packed.blob} ${packed.type} ${packed.scale}`;
    if (!this.decoded.has(key)) this.decoded.set(key, this.#decode(packed));
    return this.decoded.get(key);
  }

  #decode(packed) {
    const written = arrayOf(this.blobs[packed.blob], packed.type);
    if (packed.scale === undefined) return written;
    const values = new Float64Array(written.length);
    for (let k = 0; k < written.length; k += 1) {
      values[k] = written[k] === packed.missing ? NaN : written[k] * packed.scale;
    }
    return values;
  }

  /** All columns of a table by name. */
  table(packed) {
    return Object.fromEntries(Object.entries(packed).map(([name, column]) => [name, this.column(column)]));
  }
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
  constructor(packed, columns) {
    this.map = packed.map.map((line) => ({ kind: line.kind, x: columns.column(line.x), y: columns.column(line.y) }));
    const ego = columns.table(packed.ego);
    this.ego = new Path(ego, Int32Array.from(ego.t.keys()));
    const truth = columns.table(packed.truth);
    this.objects = new Map();
    for (const [object, rows] of rowsOf(truth.object)) this.objects.set(object, new Path(truth, rows));
    this.end = Math.max(this.ego.t.at(-1) ?? 0, ...truth.t.slice(-1), 0);
  }
}

/** A run, indexed by time. */
class Run {
  constructor(packed, recordings, columns) {
    this.label = packed.label;
    this.recording = recordings[packed.recording];
    this.statuses = packed.statuses;
    this.sensors = packed.sensors;
    this.dispositions = packed.dispositions;
    this.ticks = columns.column(packed.ticks);
    this.step = medianStep(this.ticks);
    this.tracks = columns.table(packed.tracks);
    this.tracksOfTick = startsOfTicks(this.ticks, this.tracks.t);
    this.trackBefore = rowsBefore(this.tracks.track);
    this.past = columns.table(packed.past);
    this.pastOfTick = startsOfTicks(this.ticks, this.past.t);
    this.final = columns.table(packed.final);
    this.finalOfTrack = rowsOf(this.final.track);
    this.detections = columns.table(packed.detections);
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
async function readScene(text) {
  const packed = JSON.parse(text);
  const columns = new Columns(await Promise.all(packed.blobs.map(inflated)));
  const recordings = packed.recordings.map((one) => new Recording(one, columns));
  const runs = packed.runs.map((one) => new Run(one, recordings, columns));
  return {
    runs,
    palette: packed.palette,
    size: packed.size_m,
    used: new Set(packed.used),
    late: new Set(packed.late),
    sensors: [...new Set(runs.flatMap((run) => run.sensors))].sort(),
    end: Math.max(0, ...runs.map((run) => run.end)),
  };
}
