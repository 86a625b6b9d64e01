// The form of a new job: uploads at once, and shows the API's faults before anything is queued.
import { ask } from "./common.js";
import { complain, send, submits, upload } from "./form.js";

const form = document.getElementById("new");
const { object } = form.elements;
const option = (name) => form.elements[name];
const classifier = option("victim.classifier"), label = option("goal.label");
const file = document.getElementById("file");
const drop = document.getElementById("drop");
const says = document.getElementById("file-says");

async function take(picked) {
  if (!picked) return;
  const stored = await upload("/v1/objects", picked, object, "object", (share) => {
    says.textContent = share < 1 ? `${picked.name}: ${Math.round(100 * share)} % uploaded` : `${picked.name}: the server reads it`;
  });
  says.textContent = stored
    ? `${stored.name}: ${stored.triangles} triangles, ${Object.keys(stored.textures).length} textures`
    : `${picked.name} was refused`;
  if (stored) await chosen();
}

// The turntable is one picture of all turns, side by side; the slider shows one of them.
let turntable = null;
async function chosen() {
  const known = object.selectedOptions[0]?.dataset.label;
  if (known && known !== label.value) {
    label.value = known;
    for (const more of [...form.querySelectorAll(`[name='${label.name}']`)].slice(1)) more.remove();
  }
  const caption = document.querySelector(".turntable figcaption");
  caption.textContent = "The target renderer is drawing it.";
  const asked = new URLSearchParams({ background: option("views.background").value });
  if (option("views.distance").value) asked.set("distance", option("views.distance").value);
  if (option("views.renderers")) asked.set("renderer", option("views.renderers").value);
  const answer = await fetch(`/jobs/turntable/${encodeURIComponent(object.value)}.png?${asked}`).catch(() => null);
  turntable = answer?.ok ? await createImageBitmap(await answer.blob()) : null;
  caption.textContent = turntable ? "In the target renderer" : `No picture: ${await reason(answer)}`;
  turn();
}

const reason = async (answer) => (await answer?.json().catch(() => null))?.detail ?? "the server cannot be reached.";

function turn() {
  const canvas = document.getElementById("turntable"), side = turntable?.height ?? canvas.height;
  Object.assign(canvas, { width: side, height: side });
  if (turntable) canvas.getContext("2d").drawImage(turntable, -side * Number(document.getElementById("turn").value), 0);
}

async function classes() {
  const found = await ask(`/v1/classifiers/${encodeURIComponent(classifier.value)}`).catch(() => null);
  document.getElementById("classes").replaceChildren(...(found?.classes ?? []).map((name) => new Option(name)));
}

function request() {
  const spec = JSON.parse(form.querySelector("[name=preset]:checked").dataset.options);
  for (const input of form.querySelectorAll("[name*='.']")) {
    const [part, field] = input.name.split(".");
    const isNumber = ["number", "range"].includes(input.type) || (input.name === label.name && /^\d+$/.test(input.value));
    const value = input.type === "checkbox" ? input.checked : isNumber && input.value ? Number(input.value) : input.value;
    const several = input.name === label.name;
    if (value !== "") spec[part] = { ...spec[part], [field]: several ? [...(spec[part]?.[field] ?? []), value] : value };
  }
  return JSON.stringify({ ...spec, object: object.value, priority: "interactive" });
}

async function foresee() {
  const { victim, views, search, paint } = JSON.parse(request());
  const asked = new URLSearchParams({ classifier: victim.classifier, pool: views.pool, steps: search.steps, epsilon: paint.epsilon });
  const { text } = await ask(`/jobs/estimate?${asked}`).catch(() => ({ text: null }));
  const place = document.getElementById("estimate");
  place.textContent = text ?? "";
  place.hidden = !text;
}

let timer;
function check() {
  clearTimeout(timer);
  foresee();
  timer = setTimeout(() => label.value && send("/v1/jobs/check", request()).then(() => complain(null), (error) => complain(error)), 400);
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
option("views.background").onchange = chosen;
option("views.distance").onchange = chosen;
if (option("views.renderers")) option("views.renderers").onchange = chosen;
classifier.onchange = classes;
document.getElementById("more-labels").onclick = (event) => {
  const more = Object.assign(label.cloneNode(), { value: "", required: false });
  more.ariaLabel = "Another class that counts as the object";
  event.target.before(more);
  more.focus();
};
document.getElementById("turn").oninput = turn;
form.addEventListener("input", (event) => {
  if (event.target.name === "paint.epsilon") form.elements["epsilon-says"].value = event.target.value;
});
form.addEventListener("change", check);
submits("/v1/jobs", request);
await Promise.all([chosen(), classes(), foresee()]);
