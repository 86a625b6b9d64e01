// The form of a new job: uploads at once, checks with the API's own words before anything is queued.
import { Refused, ask, words } from "./common.js";

const form = document.getElementById("new");
const { object, classifier, label, background } = form.elements;
const file = document.getElementById("file");
const drop = document.getElementById("drop");
const says = document.getElementById("file-says");
const keys = new Map();

// The same request sent twice makes one job; a changed one another.
function keyOf(body) {
  if (!keys.has(body)) keys.set(body, Array.from(crypto.getRandomValues(new Uint32Array(4)), (n) => n.toString(16)).join("-"));
  return keys.get(body);
}

function complain(error, fallback = "") {
  for (const place of form.querySelectorAll("[data-error]")) place.hidden = true;
  if (!error) return;
  const problems = error instanceof Refused && error.problem.errors?.length
    ? error.problem.errors.map((each) => [String(each.field ?? each.loc?.at(-1) ?? ""), each.message ?? each.msg ?? ""])
    : [[fallback, words(error)]];
  for (const [field, text] of problems) {
    const known = [...form.querySelectorAll("[data-error]")].find((each) => field && each.dataset.error.split(" ").includes(field));
    const place = known ?? form.querySelector('[data-error=""]');
    place.textContent = known || !field ? text : `${field}: ${text}`;
    place.hidden = false;
  }
}

async function upload(path, picked, select, place) {
  const body = new FormData();
  body.append("file", picked);
  try {
    const stored = await ask(path, { method: "POST", body });
    const option = [...select.options].find((each) => each.value === stored.id) ?? new Option(stored.name, stored.id);
    option.selected = true;
    select.append(option);
    complain(null);
    return stored;
  } catch (error) {
    complain(error, place);
    return null;
  }
}

async function take(picked) {
  if (!picked) return;
  says.textContent = `${picked.name}: uploading`;
  const stored = await upload("/v1/objects", picked, object, "object");
  says.textContent = stored
    ? `${stored.name}: ${stored.triangles} triangles, ${Object.keys(stored.textures).length} textures`
    : `${picked.name} was not taken`;
  if (stored) await chosen();
}

// The turntable is one picture of all turns side by side; the slider shows one of them.
let turntable = null;
async function chosen() {
  const option = object.selectedOptions[0];
  if (option?.dataset.label) label.value = option.dataset.label;
  const figure = document.querySelector(".turntable");
  const asked = new URLSearchParams({ background: background.value });
  if (form.elements.distance.value) asked.set("distance", form.elements.distance.value);
  const answer = await fetch(`/jobs/turntable/${encodeURIComponent(object.value)}.png?${asked}`).catch(() => null);
  figure.hidden = !answer?.ok;
  if (!answer?.ok) return;
  turntable = await createImageBitmap(await answer.blob());
  turn();
}

function turn() {
  if (!turntable) return;
  const side = turntable.height;
  const canvas = Object.assign(document.getElementById("turntable"), { width: side, height: side });
  canvas.getContext("2d").drawImage(turntable, -side * Number(document.getElementById("turn").value), 0);
}

async function classes() {
  const found = await ask(`/v1/classifiers/${encodeURIComponent(classifier.value)}`).catch(() => null);
  document.getElementById("classes").replaceChildren(...(found?.classes ?? []).map((name) => new Option(name)));
}

function request() {
  const given = new FormData(form);
  const options = JSON.parse(form.querySelector("[name=preset]:checked").dataset.options);
  const spec = { ...options, object: given.get("object"), classifier: given.get("classifier"), label: given.get("label"), priority: "interactive" };
  if (/^\d+$/.test(spec.label)) spec.label = Number(spec.label);
  spec.attack_on = given.get("attack_on");
  const numbers = spec.attack_on === "texture" ? ["epsilon", "tau", "distance", "seed"] : ["distance", "seed"];
  for (const name of numbers) if (given.get(name)) spec[name] = Number(given.get(name));
  if (spec.tau !== undefined) spec.saliency_scope = given.get("saliency_scope");
  if (given.get("background")) spec.background = [given.get("background")];
  return JSON.stringify(spec);
}

const send = (path, headers = {}) =>
  ask(path, { method: "POST", body: request(), headers: { "Content-Type": "application/json", ...headers } });

let timer;
function check() {
  clearTimeout(timer);
  timer = setTimeout(() => label.value && send("/v1/jobs/check").then(() => complain(null), (error) => complain(error)), 400);
}

file.onchange = () => take(file.files[0]);
for (const name of ["dragenter", "dragover"])
  drop.addEventListener(name, (event) => {
    event.preventDefault();
    drop.classList.add("over");
  });
for (const name of ["dragleave", "drop"])
  drop.addEventListener(name, (event) => {
    event.preventDefault();
    drop.classList.remove("over");
  });
drop.addEventListener("drop", (event) => take(event.dataTransfer.files[0]));
document.getElementById("classifier-file").onchange = async (event) => {
  const [picked] = event.target.files;
  if (picked && (await upload("/v1/classifiers", picked, classifier, "classifier"))) await classes();
};
object.onchange = chosen;
background.onchange = chosen;
form.elements.distance.onchange = chosen;
classifier.onchange = classes;
document.getElementById("turn").oninput = turn;
form.addEventListener("input", (event) => {
  if (event.target.name === "epsilon") form.elements["epsilon-says"].value = event.target.value;
});
form.addEventListener("change", check);
form.addEventListener("submit", async (event) => {
  event.preventDefault();
  const button = form.querySelector(":scope > button");
  button.disabled = true;
  try {
    const job = await send("/v1/jobs", { "Idempotency-Key": keyOf(request()) });
    location.assign(`/jobs/${job.id}`);
  } catch (error) {
    complain(error);
    button.disabled = false;
  }
});
await Promise.all([chosen(), classes()]);
