// Lights of the renderer workers in three's units, for objects made by the caller. Colours are linear, [r, g, b] in [0, 1].

// An ambient light of `color`.
export function setAmbient(light, color) {
  light.color.setRGB(...color);
  light.intensity = Math.PI;
}

// A directional or point light: white matt surfaces that face it reflect `intensity`.
export function setLight(light, { color, intensity }) {
  light.color.setRGB(...color);
  light.intensity = Math.PI * intensity;
}

// Aim a directional light from the direction `towards` at a sphere, whose shadows it casts on itself.
export function aimSun(sun, towards, { center, radius }) {
  sun.target.position.copy(center);
  sun.position.fromArray(towards).setLength(2 * radius).add(center);
  const box = sun.shadow.camera;
  [box.left, box.bottom, box.right, box.top] = [-1, -1, 1, 1].map((side) => 1.01 * side * radius);
  [box.near, box.far] = [0.9 * radius, 3.1 * radius];
  box.updateProjectionMatrix();
  sun.shadow.mapSize.set(1024, 1024);
  sun.shadow.normalBias = 0.01 * radius;
  sun.shadow.bias = -0.002;
}
