// Shared by the forms: uploads at once, faults beside their fields, one job for one request.
import { Refused, answered, ask, words } from "./common.js";

const form = document.getElementById("new");
const button = form.querySelector("button.button");
const keys = new Map(), uploads = new Map();

// The same request has the same key, and makes one job.
function keyOf(body) {
  if (!keys.has(body)) keys.set(body, Array.from(crypto.getRandomValues(new Uint32Array(4)), (n) => n.toString(16)).join("-"));
  return keys.get(body);
}

// Show the faults of an error, or none. Those of an upload (`own`: its place) leave what is told of others, and stay
// until another file is stored or chosen.
export function complain(error, own = "") {
  for (const place of form.querySelectorAll("[data-error]")) {
    const { error: names, refused } = place.dataset;
    if (own ? !names || names.split(" ").includes(own) : !refused) place.hidden = true;
  }
  if (!error) return;
  if (own) form.elements[own].addEventListener("change", () => complain(null, own), { once: true });
  const faults = error.problem?.errors ?? [{ field: own, message: words(error) }];
  for (const { field, message } of faults) {
    const known = [...form.querySelectorAll("[data-error]")].find(
      (each) => each.dataset.error && each.dataset.error.split(" ").some((name) => `${field}.`.startsWith(`${name}.`) || name.startsWith(`${field}.`)));
    const place = known ?? form.querySelector('[data-error=""]');
    place.textContent = known || !field ? message : `${field}: ${message}`;
    place.dataset.refused = own;
    place.hidden = false;
  }
}

// Upload a file and choose it; nothing can be submitted until then. Returns what is stored, null if it is refused, and
// undefined if another file was picked meanwhile.
export async function upload(path, picked, select, place, { onShare = () => {}, fields = {} } = {}) {
  const body = new FormData();
  body.append("file", picked);
  for (const [name, text] of Object.entries(fields)) body.append(name, text);
  uploads.get(select)?.abort();
  const request = new XMLHttpRequest();
  uploads.set(select, request);
  button.disabled = true;
  try {
    const stored = await answered(await posted(request, path, body, onShare));
    const option = [...select.options].find((each) => each.value === stored.id) ?? new Option(stored.name, stored.id);
    option.selected = true;
    select.append(option);
    complain(null, place);
    return stored;
  } catch (error) {
    if (uploads.get(select) !== request) return undefined;
    complain(error, place);
    return null;
  } finally {
    if (uploads.get(select) === request) uploads.delete(select);
    button.disabled = uploads.size > 0;
  }
}

// Upload a network and choose it. A .json file picked with it holds the names of its classes.
export async function uploadNetwork({ files }, select) {
  const [names, file] = [true, false].map((isJson) => [...files].find(({ name }) => /\.json$/i.test(name) === isJson));
  if (file) return upload("/v1/classifiers", file, select, select.name, { fields: names ? { classes: await names.text() } : {} });
  if (names) complain(new Refused({ detail: "Pick the network's file together with its class names." }), select.name);
  return null;
}

// Post with `onShare` told the share that is sent, which `fetch` does not tell.
function posted(request, path, body, onShare) {
  return new Promise((done, fail) => {
    request.upload.onprogress = ({ loaded, total }) => onShare(loaded / total);
    request.onload = () => done(new Response(request.response, { status: request.status }));
    request.onerror = request.onabort = () => fail(new TypeError("no connection"));
    request.open("POST", path);
    onShare(0);
    request.send(body);
  });
}

// Post a request, unless a field holds what its browser cannot read as a number: its value would be empty.
export async function send(path, body, headers = {}) {
  const errors = [...form.elements].filter((each) => each.validity?.badInput)
    .map((each) => ({ field: each.name, message: "This is not a number." }));
  if (errors.length) throw Object.assign(new Error(errors[0].message), { problem: { errors } });
  return ask(path, { method: "POST", body, headers: { "Content-Type": "application/json", ...headers } });
}

// Submit what `request` gives as JSON, and go to the job. Until then the button is disabled: the form has no address.
export function submits(path, request) {
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    button.disabled = true;
    try {
      const job = await send(path, request(), { "Idempotency-Key": keyOf(request()) });
      location.assign(`/jobs/${job.id}`);
    } catch (error) {
      complain(error);
      button.disabled = false;
    }
  });
  button.disabled = false;
}
