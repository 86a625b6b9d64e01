// <trompe-viewer>: target images before and after, a divider between them, all views one after the other.
// Its JSON: [{name, views: [{before, after, difference, says_before, says_after, kept_before, kept_after, where}]}]

const element = (tag, properties = {}, ...children) => {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
};

// The first fooled view: one that was recognised shows more than one that never was.
const first = (views) => Math.max(0, views.findIndex((view) => view.kept_before && !view.kept_after));

class Viewer extends HTMLElement {
  connectedCallback() {
    this.sets = JSON.parse(this.querySelector("script").textContent);
    this.views = this.sets[0].views;
    this.build();
    this.go(first(this.views));
  }

  build() {
    this.before = element("img", { className: "before", draggable: false });
    this.after = element("img", { className: "after", draggable: false });
    this.stage = element("div", { className: "stage" }, this.before, this.after, element("div", { className: "line" }));
    this.saysBefore = element("p");
    this.saysAfter = element("p");
    this.where = element("p", { className: "quiet" });
    this.divider = element("input", { type: "range", min: 0, max: 100, value: 50, ariaLabel: "Divider: before left of it, after right" });
    this.turn = element("input", { type: "range", min: 0, value: 0, ariaLabel: "View" });
    this.play = element("button", { type: "button", textContent: "Play" });
    this.amplified = element("input", { type: "checkbox" });
    const row = element("div", { className: "row" }, this.play, element("label", {}, this.amplified, " difference × 10"));
    if (this.sets.length > 1) {
      this.choice = element("select", {}, ...this.sets.map(({ name }) => element("option", { textContent: name })));
      row.append(element("label", {}, "Views ", this.choice));
    }
    if (!this.views[0].difference) this.amplified.parentElement.remove();
    this.append(
      this.stage,
      element("div", { className: "sides", ariaLive: "polite" }, this.saysBefore, this.saysAfter),
      element("div", { className: "controls" },
        element("label", {}, "Divider ", this.divider), element("label", {}, "View ", this.turn), this.where, row),
    );
    this.listen();
  }

  listen() {
    this.divider.oninput = () => this.stage.style.setProperty("--divider", `${this.divider.value}%`);
    this.turn.oninput = () => this.go(Number(this.turn.value));
    this.amplified.onchange = () => this.go(this.index);
    if (this.choice) this.choice.onchange = () => this.choose(this.choice.selectedIndex);
    const drag = (event) => {
      const box = this.stage.getBoundingClientRect();
      this.divider.value = (100 * (event.clientX - box.left)) / box.width;
      this.divider.oninput();
    };
    this.stage.onpointerdown = (event) => {
      event.preventDefault();
      this.stage.setPointerCapture(event.pointerId);
      this.stage.onpointermove = drag;
      drag(event);
    };
    this.stage.onpointerup = this.stage.onpointercancel = () => { this.stage.onpointermove = null; };
    this.play.onclick = () => this.toggle();
  }

  toggle() {
    clearInterval(this.timer);
    this.timer = this.timer ? null : setInterval(() => this.go((this.index + 1) % this.views.length), 400);
    this.play.textContent = this.timer ? "Pause" : "Play";
  }

  choose(number, index) {
    this.views = this.sets[number].views;
    if (this.choice) this.choice.selectedIndex = number;
    this.go(index ?? first(this.views));
  }

  go(index) {
    this.index = index;
    const view = this.views[index];
    this.turn.max = this.views.length - 1;
    this.turn.value = index;
    this.turn.setAttribute("aria-valuetext", `view ${index + 1} of ${this.views.length}`);
    this.before.src = view.before;
    this.before.alt = `Before: ${view.says_before}`;
    this.after.src = this.amplified.checked ? view.difference : view.after;
    this.after.alt = `After: ${view.says_after}`;
    this.say(this.saysBefore, "Before: ", view.says_before, view.kept_before);
    this.say(this.saysAfter, "After: ", view.says_after, view.kept_after);
    this.where.textContent = view.where;
    this.mark(index);
  }

  // The dot of the view on the map of a result.
  mark(index) {
    const set = this.sets.findIndex(({ views }) => views === this.views);
    for (const dot of document.querySelectorAll(".sphere .shown")) dot.classList.remove("shown");
    document.querySelector(`.sphere [data-set="${set}"][data-view="${index}"]`)?.classList.add("shown");
  }

  say(place, title, text, right) {
    place.replaceChildren(title, element("span", { className: right ? "true" : "wrong", textContent: text }));
  }
}

customElements.define("trompe-viewer", Viewer);

// The map beside the viewer leads to its views, and marks the one that is shown.
document.querySelector(".sphere")?.addEventListener("click", (event) => {
  const dot = event.target.closest("[data-view]");
  if (!dot) return;
  const viewer = document.querySelector("trompe-viewer");
  viewer.choose(Number(dot.dataset.set), Number(dot.dataset.view));
  viewer.scrollIntoView({ block: "nearest" });
});
