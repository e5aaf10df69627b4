"use strict";
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
