"use strict";
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
