// The form of a new judgement.
import { submits, upload, uploadNetwork } from "./form.js";
import { Turntable } from "./turntable.js";

const form = document.getElementById("new"), { elements } = form;

for (const input of document.querySelectorAll("input[data-for]")) {
  const name = input.dataset.for, select = elements[name];
  input.onchange = async () => {
    if (name === "networks") await uploadNetwork(input, select);
    else if (input.files[0] && (await upload("/v1/objects", input.files[0], select, name))) select.onchange();
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
