// <trompe-orbit>: the object before and after in one WebGL scene, and what a network says of both while they are turned.
// Its JSON is that of orbit.py. With `views` instead of `classifiers` it shows the answers to the nearest judged view.

const SIDE = 448;
const KEY_STEP = 5;
const DRAG_STEP = 0.4;
const PAUSE = 60;  // milliseconds between two requests, within the server's rate

const element = (tag, properties = {}, ...children) => {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
};

function direction(azimuth, elevation) {
  const [a, e] = [azimuth, elevation].map((degrees) => (degrees * Math.PI) / 180);
  return [Math.cos(e) * Math.sin(a), Math.sin(e), Math.cos(e) * Math.cos(a)];
}

// One scene of the object before and after; one is drawn left, the other one right.
class Stage {
  constructor(THREE, lights, models, { fov, centred, size }) {
    Object.assign(this, { lights, side: Math.max(SIDE, ...size) });
    this.renderer = new THREE.WebGLRenderer({ antialias: true });
    this.renderer.shadowMap.enabled = true;
    this.renderer.shadowMap.autoUpdate = false;
    this.renderer.setSize(2 * this.side, this.side, false);
    this.renderer.setScissorTest(true);
    this.canvas = this.renderer.domElement;
    this.scene = new THREE.Scene();
    this.scene.background = new THREE.Color();
    this.ambient = new THREE.AmbientLight();
    this.halves = models.map((model) => new Half(THREE, model));
    this.scene.add(this.ambient, ...this.halves.map(({ group }) => group));
    this.ball = new THREE.Box3().setFromObject(models[0]).getBoundingSphere(new THREE.Sphere());
    this.centre = new THREE.Vector3().fromArray(centred ? models[0].userData.centre : [0, 0, 0]);
    this.camera = new THREE.PerspectiveCamera(fov);
  }

  // `onShare` is told what is loaded, in words.
  static async open(given, onShare) {
    onShare("Loading three.js");
    const [THREE, lights] = await Promise.all([import(given.files.three), import(given.files.lights)]);
    const loaded = [0, 0];
    const models = await Promise.all([given.models.before, given.models.after].map(async (address, side) => {
      const data = await download(address, (bytes) => {
        loaded[side] = bytes;
        onShare(`Loading the object: ${megabytes(loaded[0])} before, ${megabytes(loaded[1])} after`);
      });
      return parse(THREE, data);
    }));
    return new Stage(THREE, lights, models, given);
  }

  place(pose) {
    this.camera.position.fromArray(direction(pose.azimuth, pose.elevation)).multiplyScalar(pose.distance).add(this.centre);
    this.camera.lookAt(this.centre);
    this.camera.near = Math.max(pose.distance - 3 * this.ball.radius, 0.01 * pose.distance);
    this.camera.far = pose.distance + 3 * this.ball.radius;
    this.scene.background.set(pose.background);
    this.lights.setAmbient(this.ambient, Array(3).fill(pose.ambient));
    for (const half of this.halves) {
      this.lights.setLight(half.sun, { color: pose.colour, intensity: pose.intensity });
      half.aim(this.lights, direction(pose.light_azimuth, pose.light_elevation), this.ball);
    }
  }

  draw() {
    this.halves.forEach((half, number) => this.render(half, number * this.side, this.side, this.side));
  }

  render(half, x, width, height) {
    for (const each of this.halves) each.group.visible = each === half;
    this.renderer.shadowMap.needsUpdate = half.isTurned;
    half.isTurned = false;
    this.renderer.setViewport(x, 0, width, height);
    this.renderer.setScissor(x, 0, width, height);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.renderer.render(this.scene, this.camera);
  }

  // Both pictures of the network's size, as PNG; `draw` must follow.
  pictures([height, width]) {
    const copies = this.halves.map((half) => {
      this.render(half, 0, width, height);
      const copy = element("canvas", { width, height });
      copy.getContext("2d").drawImage(this.canvas, 0, this.side - height, width, height, 0, 0, width, height);
      return new Promise((done) => copy.toBlob(done));
    });
    return Promise.all(copies);
  }
}

// A model and the sun that shines on it, whose shadows are drawn anew only when it has moved.
class Half {
  constructor(THREE, model) {
    this.sun = new THREE.DirectionalLight();
    this.sun.castShadow = true;
    this.group = new THREE.Group().add(model, this.sun, this.sun.target);
  }

  aim(lights, towards, ball) {
    this.isTurned ||= String(towards) !== String(this.towards);
    this.towards = towards;
    lights.aimSun(this.sun, towards, ball);
  }
}

const megabytes = (bytes) => `${(bytes / 1e6).toFixed(1)} MB`;

// The bytes at `address`; `onBytes` is told their number so far.
async function download(address, onBytes) {
  const answer = await fetch(address);
  if (!answer.ok) throw new Error((await answer.json().catch(() => ({}))).detail ?? `The server answered ${answer.status}.`);
  const chunks = [];
  let bytes = 0;
  for (const reader = answer.body.getReader(); ;) {
    const { done, value } = await reader.read();
    if (done) return new Blob(chunks).arrayBuffer();
    chunks.push(value);
    onBytes(bytes += value.length);
  }
}

async function parse(THREE, data) {
  const loader = new THREE.GLTFLoader();
  loader.register((parser) => {
    parser.textureLoader = new THREE.TextureLoader(parser.options.manager);  // the other one needs connect-src blob:
    return { name: "textures as images" };
  });
  const { scene } = await loader.parseAsync(data, "");
  scene.traverse((mesh) => {
    if (!mesh.isMesh) return;
    mesh.castShadow = mesh.receiveShadow = !mesh.material.transparent;
    mesh.material.shadowSide = THREE.FrontSide;  // as the renderer: the faces that light meets
  });
  return scene;
}

const RANGES = [
  ["azimuth", "Azimuth", -180, 180, 1], ["elevation", "Elevation", -90, 90, 1], ["distance", "Distance", 0, 0, 0],
  ["light_azimuth", "Light's azimuth", -180, 180, 1], ["light_elevation", "Light's elevation", -90, 90, 1],
];
const WAY = [
  ["jpeg", "JPEG quality", 5, 96, 96], ["resize", "Size", 0.1, 1, 1], ["blur", "Blur, pixels", 0, 6, 0], ["gain", "Brightness", 0.2, 2, 1],
];  // name, title, range, and the value that changes nothing

class Orbit extends HTMLElement {
  connectedCallback() {
    this.given = JSON.parse(this.querySelector("script").textContent);
    this.pose = { ...this.given.start };
    this.starter = this.querySelector("button");
    this.status = this.querySelector("[role=status]");
    this.message = this.querySelector(".error");
    this.starter.onclick = () => this.open();
  }

  complain(text) {
    this.message.textContent = text;
    this.message.hidden = !text;
  }

  async open() {
    if (!document.createElement("canvas").getContext("webgl2")) {
      this.complain("This browser has no WebGL, so it cannot draw the object. The images of the target renderer are above.");
      return;
    }
    this.starter.disabled = true;
    try {
      this.stage = await Stage.open(this.given, (text) => { this.status.textContent = text; });
      this.build();
      this.turned();
      this.starter.parentElement.remove();
    } catch (error) {
      this.complain(`The object cannot be drawn: ${error.message}`);
      this.status.textContent = "";
      this.starter.disabled = false;
    }
  }

  build() {
    const { canvas } = this.stage;
    Object.assign(canvas, { tabIndex: 0, ariaLabel: "The object before (left) and after (right); turn it with the arrow keys" });
    canvas.setAttribute("role", "img");
    canvas.addEventListener("webglcontextlost", () => this.complain("The browser has stopped WebGL; load the page again."));
    this.says = [element("p"), element("p")];
    this.note = element("p", { className: "quiet" });
    const inputs = RANGES.map((row) => this.range(...row));
    const background = element("input", { type: "color", name: "background", value: this.pose.background });
    background.oninput = () => this.set({ background: background.value });
    this.append(
      canvas,
      element("div", { className: "sides" }, ...this.says),
      this.note,
      element("div", { className: "fields" }, ...inputs, element("label", {}, "Background ", background), ...this.network()),
    );
    this.listen(canvas);
  }

  range(name, title, least, most, step) {
    const input = element("input", { type: "range", name });
    const usual = this.pose[name];
    Object.assign(input, name === "distance" ? { min: usual / 2, max: 2 * usual, step: usual / 50 } : { min: least, max: most, step });
    input.value = usual;
    input.oninput = () => this.set({ [name]: Number(input.value) });
    return element("label", {}, title, input);
  }

  // Choice of the network and what happens to a picture on its way to it.
  network() {
    if (!this.given.classifiers) return [];
    this.classifier = element("select", { name: "classifier" },
      ...this.given.classifiers.map(({ reference, name }) => new Option(name, reference)));
    this.classifier.onchange = () => this.turned();
    this.way = WAY.map(([name, , min, max, value]) => {
      const input = element("input", { type: "range", name, min, max, step: name === "jpeg" ? 1 : 0.05 });
      input.value = value;
      input.oninput = () => this.turned();
      return input;
    });
    return [element("label", {}, "Network ", this.classifier), ...this.way.map((input, each) => element("label", {}, WAY[each][1], input))];
  }

  listen(canvas) {
    canvas.onpointerdown = (event) => canvas.setPointerCapture(event.pointerId);
    canvas.onpointermove = ({ buttons, movementX, movementY }) => {
      if (buttons) this.turn(-DRAG_STEP * movementX, DRAG_STEP * movementY);
    };
    const keys = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    canvas.onkeydown = (event) => {
      if (!keys[event.key]) return;
      event.preventDefault();
      this.turn(...keys[event.key].map((sign) => KEY_STEP * sign));
    };
  }

  turn(right, up) {
    const azimuth = ((this.pose.azimuth + right + 540) % 360) - 180;
    this.set({ azimuth, elevation: Math.min(90, Math.max(-90, this.pose.elevation + up)) });
  }

  set(changes) {
    Object.assign(this.pose, changes);
    for (const [name, value] of Object.entries(changes)) {
      const input = this.querySelector(`[name=${name}]`);
      if (input) input.value = value;
    }
    this.turned();
  }

  async turned() {
    this.isOld = true;
    if (this.isAsking) return;
    this.isAsking = true;
    while (this.isOld) {
      this.isOld = false;
      this.stage.place(this.pose);
      const answered = this.answer({ ...this.pose });
      this.stage.draw();
      await answered;
    }
    this.isAsking = false;
  }

  async answer(pose) {
    try {
      const found = await (this.given.views ? this.nearest(pose) : this.classified());
      ["Before", "After"].forEach((title, side) => this.say(this.says[side], title, found[side]));
      this.complain("");
    } catch (error) {
      this.complain(error.message);
    }
    this.dataset.answered = JSON.stringify(pose);
  }

  say(place, title, { text, right, truth }) {
    const answer = element("span", { className: right ? "true" : "wrong", textContent: text });
    place.replaceChildren(`${title}: `, answer, element("span", { className: "quiet", textContent: ` as ${this.given.label}: ${truth}` }));
  }

  async classified() {
    const body = new FormData();
    (await this.stage.pictures(this.given.size)).forEach((picture) => body.append("images", picture, "view.png"));
    for (const label of this.given.classifiers[this.classifier.selectedIndex].labels) body.append("label", label);
    body.append("classifier", this.classifier.value);
    this.way.forEach((input, each) => {
      if (Number(input.value) !== WAY[each][4]) body.append(input.name, input.value);
    });
    const pause = new Promise((done) => setTimeout(done, PAUSE));
    const answer = await fetch("/v1/classify", { method: "POST", body })
      .catch(() => { throw new Error("The server cannot be reached; check that it runs, then turn the object again."); });
    const found = await answer.json();
    await pause;
    if (!answer.ok) throw new Error(found.detail);
    return found.map((each) => ({
      text: `${each.name ?? `class ${each.index}`} ${percent(each.confidence)}`,
      right: each.correct,
      truth: percent(each.true_confidence),
    }));
  }

  async nearest(pose) {
    const own = direction(pose.azimuth, pose.elevation);
    const cosines = this.given.views.map((view) => direction(view.azimuth, view.elevation).reduce((sum, each, axis) => sum + each * own[axis], 0));
    const best = Math.max(...cosines), view = this.given.views[cosines.indexOf(best)];
    const away = Math.round((Math.acos(Math.min(1, best)) * 180) / Math.PI);
    this.note.textContent = `Answers to the nearest judged view, ${away}° away, in the target renderer. ${view.where}`;
    return ["before", "after"].map((side) => ({ text: view[`says_${side}`], right: view[`kept_${side}`], truth: view[`truth_${side}`] }));
  }
}

const percent = (share) => `${Math.round(100 * share)}%`;

customElements.define("trompe-orbit", Orbit);
