// One picture at a time for engine.py: meshes and textures by key, then `draw`. Matrices are lists of rows.
import { aimSun, setAmbient, setLight } from "./lights.js";
import * as THREE from "./three.module.min.js";

const meshes = new Map(), textures = new Map(), slots = [];
const scene = new THREE.Scene(), camera = new THREE.PerspectiveCamera();
const ambient = new THREE.AmbientLight(), suns = [], lamps = [];
const ball = new THREE.Sphere();
let renderer, options, backdrop;
scene.add(ambient);
camera.matrixAutoUpdate = false;

const TONES = {none: "No", aces: "ACESFilmic", agx: "AgX", neutral: "Neutral", reinhard: "Reinhard", cineon: "Cineon"};

const bytes = async text => (await fetch("data:;base64," + text)).arrayBuffer();

function text(pixels) {
  let all = "";
  for (let start = 0; start < pixels.length; start += 8192) {
    all += String.fromCharCode(...pixels.subarray(start, start + 8192));
  }
  return btoa(all);
}

function start(given) {
  options = given;
  renderer = new THREE.WebGLRenderer({antialias: options.antialias, preserveDrawingBuffer: true});
  renderer.toneMapping = THREE[TONES[options.tone] + "ToneMapping"];
  renderer.toneMappingExposure = options.exposure;
  renderer.shadowMap.enabled = options.shadows;
  renderer.debug.onShaderError = (gl, program) => { throw new Error("shader: " + gl.getProgramInfoLog(program)); };
  return THREE.REVISION;
}

async function addMesh(key, arrays) {
  const geometry = new THREE.BufferGeometry();
  for (const [name, size] of [["position", 3], ["normal", 3], ["uv", 2]]) {
    geometry.setAttribute(name, new THREE.BufferAttribute(new Float32Array(await bytes(arrays[name])), size));
  }
  geometry.setIndex(new THREE.BufferAttribute(new Uint32Array(await bytes(arrays.index)), 1));
  meshes.set(key, geometry);
}

async function addTexture(key, width, height, rgba, isColor) {
  textures.set(key, image(new Uint8Array(await bytes(rgba)), width, height, isColor, true));
}

function image(rgba, width, height, isColor, mipmapped) {
  const texture = new THREE.DataTexture(rgba, width, height);
  if (isColor) texture.colorSpace = THREE.SRGBColorSpace;
  texture.wrapS = texture.wrapT = THREE.RepeatWrapping;
  if (mipmapped) {
    texture.minFilter = THREE.LinearMipmapLinearFilter;
    texture.magFilter = THREE.LinearFilter;
    texture.generateMipmaps = true;
    texture.anisotropy = options.anisotropy;
  }
  texture.needsUpdate = true;
  return texture;
}

function drop(key) {
  for (const kept of [meshes, textures]) {
    kept.get(key)?.dispose();
    kept.delete(key);
  }
}

function place(number, item) {
  if (!slots[number]) {
    slots[number] = new THREE.Mesh(undefined, new THREE.MeshStandardMaterial({shadowSide: THREE.FrontSide}));
    slots[number].matrixAutoUpdate = false;
    slots[number].castShadow = slots[number].receiveShadow = true;
    slots[number].frustumCulled = false;
    scene.add(slots[number]);
  }
  const mesh = slots[number], material = mesh.material;
  mesh.geometry = meshes.get(item.mesh);
  mesh.matrix.set(...item.pose.flat());
  mesh.matrixWorldNeedsUpdate = mesh.visible = true;
  material.map = textures.get(item.albedo);
  material.normalMap = textures.get(item.normal) ?? null;
  material.roughnessMap = material.metalnessMap = textures.get(item.metallic) ?? null;
  material.roughness = item.metallic ? 1 : item.roughness;
  material.metalness = item.metallic ? 1 : 0;
  material.transparent = item.opacity !== null;
  material.depthWrite = mesh.castShadow = !material.transparent;
  material.opacity = item.opacity ?? 1;
  material.alphaTest = item.cutoff;
  const kind = [!!item.normal, !!item.metallic, material.transparent, item.cutoff].join();
  if (mesh.userData.kind !== kind) material.needsUpdate = true;
  mesh.userData.kind = kind;
}

function light(lights, number, make, item) {
  if (!lights[number]) {
    lights[number] = make();
    scene.add(lights[number]);
    if (lights[number].target) scene.add(lights[number].target);
  }
  lights[number].visible = true;
  setLight(lights[number], item);
  return lights[number];
}

function shine(world) {
  setAmbient(ambient, world.ambient);
  for (const each of [...suns, ...lamps]) each.visible = false;
  world.lights.filter(item => item.kind === "Directional").forEach((item, number) => {
    const sun = light(suns, number, () => new THREE.DirectionalLight(), item);
    aimSun(sun, item.direction.map(x => -x), ball);
    sun.castShadow = options.shadows;
  });
  world.lights.filter(item => item.kind === "Point").forEach((item, number) => {
    light(lamps, number, () => new THREE.PointLight(), item).position.fromArray(item.position);
  });
}

async function show(background, width, height) {
  backdrop?.dispose();
  backdrop = undefined;
  if (Array.isArray(background)) {
    scene.background = new THREE.Color().setRGB(...background, THREE.SRGBColorSpace);
  } else {
    scene.background = backdrop = image(new Uint8Array(await bytes(background)), width, height, true, false);
  }
}

async function draw(world, width, height) {
  const gl = renderer.getContext();
  renderer.setSize(width, height, false);
  if (gl.isContextLost()) throw new Error("the WebGL context is lost");
  if (gl.drawingBufferWidth !== width || gl.drawingBufferHeight !== height) {
    throw new Error(`Chromium draws ${gl.drawingBufferWidth} x ${gl.drawingBufferHeight} pixels at most here`);
  }
  Object.assign(camera, {fov: world.fov, aspect: width / height, near: world.near, far: world.far});
  camera.updateProjectionMatrix();
  camera.matrix.set(...world.camera.flat());
  camera.matrixWorldNeedsUpdate = true;
  ball.center.fromArray(world.centre);
  ball.radius = world.radius;
  for (const slot of slots) slot.visible = false;
  world.items.forEach((item, number) => place(number, item));
  shine(world);
  await show(world.background, width, height);
  renderer.render(scene, camera);
  const pixels = new Uint8Array(4 * width * height);
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
  return text(pixels);
}

window.trompe = {start, addMesh, addTexture, drop, draw};
