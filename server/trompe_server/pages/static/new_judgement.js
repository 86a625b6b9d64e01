// The form of a new judgement.
import { submits, upload } from "./form.js";

const { elements } = document.getElementById("new");

for (const input of document.querySelectorAll("input[data-for]")) {
  const name = input.dataset.for, path = name === "networks" ? "/v1/classifiers" : "/v1/objects";
  input.onchange = () => input.files[0] && upload(path, input.files[0], elements[name], name);
}

function request() {
  const given = (name) => elements[name].value;
  const body = { before: given("before"), after: given("after"), networks: [given("networks")], priority: "interactive" };
  body.label = /^\d+$/.test(given("label")) ? Number(given("label")) : given("label");
  if (given("suite")) body.suite = given("suite");
  for (const name of ["views", "seed", "epsilon"]) if (given(name)) body[name] = Number(given(name));
  return JSON.stringify(body);
}

submits("/v1/judgements", request);
