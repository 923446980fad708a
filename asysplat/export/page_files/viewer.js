
// The page: what it shows first, and what its controls, pointers and keys do.

const MAX_PIXELS = 4e6; // of the canvas
const PLAY_SPEED = 2, MAX_PLAY_SECONDS = 30; // photographs a second
const DIRECTIONS = { // of keys, along the axes right, down and forward
  KeyA: [-1, 0, 0], KeyD: [1, 0, 0], ArrowLeft: [-1, 0, 0], ArrowRight: [1, 0, 0],
  KeyE: [0, -1, 0], KeyQ: [0, 1, 0],
  KeyW: [0, 0, 1], KeyS: [0, 0, -1], ArrowUp: [0, 0, 1], ArrowDown: [0, 0, -1],
};

const element = (id) => document.getElementById(id);
const settings = JSON.parse(element("settings").textContent);
const { path, names, up, image } = settings;
const [canvas, slider] = [element("canvas"), element("slider")];
const keys = new Set(), pointers = new Map();
let scene, renderer, sorter;
let camera, sorted; // replaced, never changed: another object is another camera
let place = 0, center = null; // on the path; the point to orbit, once one is needed
let playing = false, sorting = false, requested = false, lastTime = 0;

async function start() {
  scene = await unpack(element("spz").textContent);
  renderer = new Renderer(canvas, scene, settings);
  sorter = new Sorter(scene.positions, settings.constants.near);
  show(0);
  await sort();
  new ResizeObserver(resize).observe(canvas);
  slider.max = path.length - 1;
  element("controls").hidden = path.length < 2;
  element("message").hidden = true;
}

/** Draw soon. Nothing is drawn while nothing changes. */
function request() {
  if (!requested) requestAnimationFrame(frame);
  requested = true;
}

function frame(time) {
  requested = false;
  const seconds = Math.min((time - lastTime) / 1000, 0.1);
  lastTime = time;
  if (playing) {
    show(Math.min(place + seconds * Math.max(PLAY_SPEED, path.length / MAX_PLAY_SECONDS),
      path.length - 1));
    if (place === path.length - 1) play(false);
  }
  if (keys.size) {
    const speed = seconds * distance();
    for (const key of keys) travel(DIRECTIONS[key].map((direction) => speed * direction));
  }
  renderer.draw(camera);
  sort();
}

/** Sort the Gaussians until they are sorted for the camera; draw what is there meanwhile. */
async function sort() {
  if (sorting || sorted === camera) return;
  sorting = true;
  while (sorted !== camera) {
    const next = camera;
    renderer.setOrder(await sorter.sort(next));
    sorted = next;
    request();
  }
  sorting = false;
}

function resize() {
  const area = canvas.clientWidth * canvas.clientHeight;
  const ratio = Math.min(devicePixelRatio, 2, Math.sqrt(MAX_PIXELS / area));
  canvas.width = Math.max(1, Math.round(ratio * canvas.clientWidth));
  canvas.height = Math.max(1, Math.round(ratio * canvas.clientHeight));
  renderer.draw(camera); // at once, as a canvas of another size is empty
}

/** Show the camera at a place on the path; at place i is camera i. */
function show(next) {
  place = next;
  slider.value = place;
  const nearest = Math.round(place);
  element("name").textContent = names[nearest] ?? `${nearest + 1} / ${path.length}`;
  center = null;
  setCamera(cameraAt(path, place));
}

function setCamera(next) {
  camera = next;
  request();
}

function play(on) {
  playing = on;
  element("play").textContent = playing ? "❚❚" : "▶";
  if (playing && place === path.length - 1) show(0);
  request();
}

function step(by) {
  play(false);
  show(Math.min(Math.max(Math.round(place) + by, 0), path.length - 1));
}

/** Return the point to orbit: at first at the median depth of the image. */
function pivot() {
  if (!center) {
    const depths = renderer.depthMap(camera).depths.filter((depth) => depth > 0).sort();
    center = move(camera, [0, 0, depths[depths.length >> 1] ?? 1]).position;
  }
  return center;
}

/** Return the distance to that point. */
const distance = () => Math.hypot(...add(pivot(), camera.position, -1));

/** Move the camera and the point to orbit along the camera's axes. */
function travel(distances) {
  const next = move(camera, distances);
  center = add(pivot(), add(next.position, camera.position, -1));
  setCamera(next);
}

function zoom(factor) {
  const offset = add(camera.position, pivot(), -1);
  setCamera({ ...camera, position: add(pivot(), offset, factor) });
}

canvas.onpointerdown = (event) => {
  play(false);
  canvas.setPointerCapture(event.pointerId);
  pointers.set(event.pointerId, event);
};

canvas.onpointerup = canvas.onpointercancel = (event) => pointers.delete(event.pointerId);

canvas.onpointermove = (event) => {
  if (!pointers.has(event.pointerId)) return;
  const before = spread();
  pointers.set(event.pointerId, event);
  const now = spread();
  const [x, y] = [now.x - before.x, now.y - before.y];
  const size = [canvas.clientWidth, canvas.clientHeight];
  if (pointers.size > 1 || event.buttons & 2 || event.shiftKey) {
    const { focal } = fit(camera.intrinsics, image, size);
    travel([-x * distance() / focal[0], -y * distance() / focal[1], 0]);
    if (pointers.size > 1) zoom(before.radius / now.radius);
  } else {
    const scale = -Math.PI / Math.min(...size);
    setCamera(orbit(camera, up, [scale * x, scale * y], pivot()));
  }
};

/** Return the mean position of all pointers, and how far the first is from it. */
function spread() {
  const all = [...pointers.values()];
  const mean = (name) => all.reduce((sum, event) => sum + event[name], 0) / all.length;
  const [x, y] = [mean("clientX"), mean("clientY")];
  return { x, y, radius: Math.max(1, Math.hypot(all[0].clientX - x, all[0].clientY - y)) };
}

canvas.oncontextmenu = (event) => event.preventDefault();

canvas.addEventListener("wheel", (event) => {
  event.preventDefault();
  play(false);
  const pixels = event.deltaY * (event.deltaMode ? 30 : 1);
  zoom(Math.exp(pixels * (event.ctrlKey ? 0.01 : 0.001))); // a pinch on a touch pad has Ctrl
}, { passive: false });

canvas.ondblclick = ({ offsetX, offsetY }) => {
  const { depths, size } = renderer.depthMap(camera);
  const pixel = [offsetX * size[0] / canvas.clientWidth, offsetY * size[1] / canvas.clientHeight];
  const [column, row] = pixel.map(Math.floor);
  const depth = depths[(size[1] - 1 - row) * size[0] + column];
  if (!(depth > 0)) return;
  const { focal, principal } = fit(camera.intrinsics, image, size);
  const [x, y] = pixel.map((value, k) => depth * (value - principal[k]) / focal[k]);
  center = move(camera, [x, y, depth]).position;
};

onkeydown = (event) => {
  const other = event.target === slider || event.ctrlKey || event.metaKey || event.altKey;
  if (other || !(event.code in DIRECTIONS)) return;
  event.preventDefault();
  play(false);
  keys.add(event.code);
};
onkeyup = (event) => keys.delete(event.code);
onblur = () => keys.clear();

element("previous").onclick = () => step(-1);
element("next").onclick = () => step(1);
element("play").onclick = () => play(!playing);
slider.oninput = () => { play(false); show(Number(slider.value)); };

canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
canvas.addEventListener("webglcontextrestored", () => {
  renderer = new Renderer(canvas, scene, settings);
  show(place);
});

const ready = start();
ready.catch(({ message }) => {
  element("message").textContent = `The scene cannot be shown: ${message}.`;
});

/** For tests and other scripts: what the page shows. */
window.asysplat = {
  ready,
  show: step,
  /** Return camera i's image, in its own size, as a PNG in a data URL. */
  async picture(i) {
    const other = cameraAt(path, i), order = await sorter.sort(other);
    renderer.setOrder(order);
    [canvas.width, canvas.height] = image;
    renderer.draw(other);
    const url = canvas.toDataURL();
    sorted = other;
    resize();
    request();
    return url;
  },
};
