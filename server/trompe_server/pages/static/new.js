// The form of a new job: uploads at once, and shows the API's faults before anything is queued.
import { Refused, ask } from "./common.js";
import { complain, send, submits, upload, uploadNetwork } from "./form.js";
import { Turntable } from "./turntable.js";

const form = document.getElementById("new");
const { object } = form.elements;
const option = (name) => form.elements[name];
const classifier = option("victim.classifier"), label = option("goal.label");
const file = document.getElementById("file");
const drop = document.getElementById("drop");
const says = document.getElementById("file-says");

async function take(picked) {
  if (!picked) return;
  const stored = await upload("/v1/objects", picked, object, "object", {
    onShare: (share) => {
      says.textContent = share < 1 ? `${picked.name}: ${Math.round(100 * share)} % uploaded` : `${picked.name}: the server reads it`;
    },
  });
  if (stored === undefined) return;
  says.textContent = stored
    ? `${stored.name}: ${stored.triangles} triangles, ${Object.keys(stored.textures).length} textures`
    : `${picked.name} was refused`;
  if (stored) await chosen();
}

const turntable = new Turntable(form.querySelector(".turntable"));
let suggested = "";
async function chosen() {
  const known = object.selectedOptions[0]?.dataset.label ?? "";
  if (known !== label.value && (known || label.value === suggested)) { // the shipped object's label goes with it
    label.value = known;
    for (const more of [...form.querySelectorAll(`[name='${label.name}']`)].slice(1)) more.remove();
  }
  suggested = known;
  const asked = { background: option("views.background").value };
  if (option("views.distance").value) asked.distance = option("views.distance").value;
  if (option("views.renderers")) asked.renderer = option("views.renderers").value;
  await turntable.show(object.value, asked);
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
for (const name of ["dragenter", "dragover", "dragleave", "drop"])
  drop.addEventListener(name, (event) => {
    event.preventDefault();
    drop.classList.toggle("over", name === "dragenter" || name === "dragover");
  });
drop.addEventListener("drop", ({ dataTransfer: { files, items } }) => {
  const many = files.length > 1 || items[0]?.webkitGetAsEntry()?.isDirectory;
  if (many) complain(new Refused({ detail: "Drop one file; pack a folder, or a model with its textures, as a zip." }), "object");
  else take(files[0]);
});
document.getElementById("classifier-file").onchange = async ({ target }) => {
  if (await uploadNetwork(target, classifier)) await classes();
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
const sayEpsilon = () => { form.elements["epsilon-says"].value = option("paint.epsilon").value; };
option("paint.epsilon").oninput = sayEpsilon;
form.addEventListener("change", ({ target }) => target.type !== "file" && check()); // uploads tell their own faults
submits("/v1/jobs", request);
// By now the browser has filled in again what it kept of a form to which one returns.
addEventListener("pageshow", () => {
  sayEpsilon();
  chosen();
  classes();
  foresee();
});
