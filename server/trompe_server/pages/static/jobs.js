// A live list of jobs: the server sends changed rows as HTML.
import { follow } from "./common.js";

const table = document.querySelector("table[data-stream]");
const compare = document.getElementById("compare");

function put(html) {
  const holder = document.createElement("tbody");
  holder.innerHTML = html;
  for (const row of [...holder.children].reverse()) {
    const old = document.getElementById(row.id);
    if (!old) table.tBodies[0].prepend(row);
    else if (old.dataset.version !== row.dataset.version && !old.contains(document.activeElement)) {
      const picked = old.querySelector("input:checked");
      old.replaceWith(row);
      if (picked) row.querySelector("input").checked = true;
    }
  }
}

if (table) follow(table.dataset.stream, "rows", put);

if (table && compare) {
  table.addEventListener("change", () => {
    const picked = [...table.querySelectorAll("input[name=compare]:checked")].map((box) => box.value);
    compare.hidden = picked.length !== 2;
    compare.href = `/jobs/compare?a=${picked[0]}&b=${picked[1]}`;
  });
}
