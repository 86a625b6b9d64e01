// A live list of jobs: the server sends the ids of all rows, changed rows as HTML, and the next page's address.
import { follow } from "./common.js";

const table = document.querySelector("table[data-stream]");
const MOST_COMPARED = 6; // as the page of the comparison takes
const compare = document.getElementById("compare"), find = document.getElementById("find");

const idOf = (row) => row.id.slice("job-".length);

function put({ ids, html, older }) {
  for (const row of [...table.tBodies[0].rows]) if (!ids.includes(idOf(row))) row.remove();
  const next = document.querySelector("a[rel=next]");
  if (next && older) Object.assign(next, { href: older, hidden: false });
  const holder = document.createElement("tbody");
  holder.innerHTML = html;
  for (const row of [...holder.children].reverse()) {
    const old = document.getElementById(row.id);
    if (!old) table.tBodies[0].insertBefore(row, document.getElementById(`job-${ids[ids.indexOf(idOf(row)) + 1]}`));
    else if (old.dataset.version === row.dataset.version) continue;
    else if (old.contains(document.activeElement)) old.newer = row;
    else replace(old, row);
  }
}

function replace(old, row) {
  const picked = old.querySelector("input:checked");
  old.replaceWith(row);
  if (picked) row.querySelector("input").checked = true;
}

// Rows by a column; empty cells last.
function sort(heading) {
  const column = heading.cellIndex, down = heading.ariaSort !== "ascending";
  const key = (row) => row.cells[column].dataset.value ?? row.cells[column].textContent.trim();
  const order = (one, other) => one - other || one.localeCompare(other);
  for (const each of table.tHead.rows[0].cells) each.removeAttribute("aria-sort");
  heading.ariaSort = down ? "ascending" : "descending";
  const rows = [...table.tBodies[0].rows].sort((a, b) => {
    const [one, other] = [key(a), key(b)];
    return !one - !other || (down ? order(one, other) : order(other, one));
  });
  table.tBodies[0].append(...rows);
}

function filter() {
  const wanted = find?.value.trim().toLowerCase() ?? "";
  for (const row of table.tBodies[0].rows) row.hidden = !row.textContent.toLowerCase().includes(wanted);
}

if (table) {
  follow(table.dataset.stream, "rows", (data) => {
    put(JSON.parse(data));
    filter();
  });
  // A row with the focus is replaced when the focus leaves it.
  table.tBodies[0].addEventListener("focusout", ({ target, relatedTarget }) => {
    const old = target.closest("tr");
    if (!old.newer || old.contains(relatedTarget)) return;
    replace(old, old.newer);
    filter();
  });
  table.tHead.addEventListener("click", (event) => event.target.matches("button") && sort(event.target.closest("th")));
  if (find) find.oninput = filter;
}

if (table && compare) {
  table.addEventListener("change", () => {
    const picked = [...table.querySelectorAll("input[name=compare]:checked")].map((box) => box.value);
    compare.hidden = picked.length < 2;
    const many = picked.length > MOST_COMPARED;
    compare.textContent = many ? `Compare at most ${MOST_COMPARED}` : `Compare these ${picked.length}`;
    if (many) compare.removeAttribute("href");
    else compare.href = `/jobs/compare?${picked.map((job) => `job=${job}`).join("&")}`;
  });
}
