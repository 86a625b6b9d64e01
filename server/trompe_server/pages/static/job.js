// A running job: its progress, then its result.
import { ask, follow } from "./common.js";

const live = document.getElementById("live");
const phases = live && JSON.parse(live.dataset.phases);

function show({ state, progress }) {
  const put = (name, text) => { live.querySelector(`[data-field=${name}]`).textContent = text ?? "–"; };
  live.querySelector("progress").value = progress.fraction;
  const phase = state === "running" && progress.phase === "queued" ? "open" : progress.phase;
  put("phase", phases[phase] ?? phase);
  put("step", progress.step == null ? null : `${progress.step} of ${progress.steps}`);
  put("loss", progress.loss?.toFixed(3));
  put("fooled", progress.fooled == null ? null : `${Math.round(100 * progress.fooled)} %`);
  put("eta", progress.eta_seconds == null ? null : left(progress));
}

function left(progress) {
  const most = span(progress.eta_seconds), least = span(progress.eta_least_seconds ?? progress.eta_seconds);
  return least === most ? most : `${least} to ${most}`;
}

const span = (seconds) => (seconds < 90 ? `${Math.round(seconds)} s` : `${Math.round(seconds / 60)} min`);

// Curves over the steps, from the events of the whole job, which the stream repeats from the first one.
const curves = { loss: new Map(), fooled: new Map() };
function draw(progress) {
  for (const [name, points] of Object.entries(curves)) {
    if (progress.step == null || progress[name] == null) continue;
    points.set(progress.step, progress[name]);
    if (points.size < 2) continue;
    const values = [...points.values()], steps = [...points.keys()];
    const low = Math.min(0, ...values), high = Math.max(name === "fooled" ? 1 : low + 1e-9, ...values), last = Math.max(2, ...steps);
    const figure = live.querySelector(`[data-curve=${name}]`);
    const at = (step) => `${(300 * (step - 1)) / (last - 1)},${85 - (80 * (points.get(step) - low)) / (high - low)}`;
    figure.querySelector("polyline").setAttribute("points", steps.sort((a, b) => a - b).map(at).join(" "));
    figure.querySelector("figcaption span").textContent = `${low.toPrecision(2)} to ${high.toPrecision(2)}, steps 1 to ${last}`;
  }
}

let shown = null;
function preview(progress) {
  const chunk = Math.floor((progress.step ?? 0) / 5);
  if (!chunk || chunk === shown) return;
  const picture = new Image(448, 224);
  picture.alt = "The object at present, in the surrogate and in the target renderer";
  picture.onload = () => {
    live.querySelector("#preview .stage").replaceChildren(picture);
    live.querySelector("#preview span")?.remove();
  };
  picture.src = `/jobs/${live.dataset.job}/preview.png?chunk=${chunk}`;
  shown = chunk;
}

if (live) {
  const stop = follow(`/v1/jobs/${live.dataset.job}/events`, "progress", (data) => {
    const event = JSON.parse(data);
    show(event);
    draw(event.progress);
    preview(event.progress);
    if (!["queued", "running"].includes(event.state)) {
      stop();
      location.reload();
    }
  });
  // A stream can end without its last event if the server restarts, and a job can be deleted, so poll too.
  setInterval(async () => {
    const { state, status } = await ask(`/v1/jobs/${live.dataset.job}`).catch((error) => error.problem ?? {});
    if (status === 404 || (state && !["queued", "running"].includes(state))) location.reload();
  }, 10000);
}
