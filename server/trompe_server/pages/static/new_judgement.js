// The form of a new judgement.
import { submits, upload } from "./form.js";
import { Turntable } from "./turntable.js";

const form = document.getElementById("new"), { elements } = form;

for (const input of document.querySelectorAll("input[data-for]")) {
  const name = input.dataset.for, path = name === "networks" ? "/v1/classifiers" : "/v1/objects";
  input.onchange = async () => {
    if (input.files[0] && (await upload(path, input.files[0], elements[name], name))) elements[name].onchange?.();
  };
}

// Both objects, turned together.
const tables = [...document.querySelectorAll(".turntable")].map((figure) => new Turntable(figure));
["before", "after"].forEach((name, index) => {
  elements[name].onchange = () => elements[name].value && tables[index].show(elements[name].value);
  addEventListener("pageshow", elements[name].onchange);
});
for (const { slider } of tables)
  slider.oninput = () => {
    for (const table of tables) {
      table.slider.value = slider.value;
      table.turn();
    }
  };

function request() {
  const given = (name) => elements[name].value;
  const body = { before: given("before"), after: given("after"), networks: [given("networks")], priority: "interactive" };
  const labels = [...form.querySelectorAll("[name=label]")].map(({ value }) => value).filter(Boolean);
  body.label = labels.map((label) => (/^\d+$/.test(label) ? Number(label) : label));
  if (given("suite")) body.suite = given("suite");
  for (const name of ["views", "seed", "epsilon"]) if (given(name)) body[name] = Number(given(name));
  return JSON.stringify(body);
}

submits("/v1/judgements", request);
