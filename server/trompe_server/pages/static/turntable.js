// An object from all sides in the target renderer: one picture of all turns side by side, of which a slider shows one.
export class Turntable {
  constructor(figure) {
    this.canvas = figure.querySelector("canvas");
    this.slider = figure.querySelector("input");
    this.caption = figure.querySelector("figcaption");
    this.slider.oninput = () => this.turn();
  }

  async show(reference, options = {}) {
    const path = `/jobs/turntable/${encodeURIComponent(reference)}.png?${new URLSearchParams(options)}`;
    this.path = path;
    this.caption.textContent = "The target renderer is drawing it.";
    this.picture = null;
    this.turn();
    const answer = await fetch(path).catch(() => null);
    const picture = answer?.ok ? await createImageBitmap(await answer.blob()) : null;
    const says = picture ? "In the target renderer" : `No picture: ${await reason(answer)}`;
    if (this.path !== path) return; // another object was chosen meanwhile
    this.picture = picture;
    this.caption.textContent = says;
    this.turn();
  }

  turn() {
    const side = this.picture?.height ?? this.canvas.height;
    Object.assign(this.canvas, { width: side, height: side });
    if (this.picture) this.canvas.getContext("2d").drawImage(this.picture, -side * Number(this.slider.value), 0);
  }
}

const reason = async (answer) => (await answer?.json().catch(() => null))?.detail ?? "the server cannot be reached.";
