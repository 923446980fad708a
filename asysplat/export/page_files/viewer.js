
// What the page shows, and what its controls, pointers and keys do.

const MAX_PIXELS = 4e6; // of the canvas
const PLAY_SPEED = 2, MAX_PLAY_SECONDS = 30; // photographs a second, at least; of the whole path
const LEFT = [-1, 0, 0], RIGHT = [1, 0, 0], FORWARD = [0, 0, 1], BACK = [0, 0, -1];
const KEYS = {
  KeyA: LEFT, KeyD: RIGHT, KeyW: FORWARD, KeyS: BACK, KeyQ: [0, 1, 0], KeyE: [0, -1, 0],
  ArrowLeft: LEFT, ArrowRight: RIGHT, ArrowUp: FORWARD, ArrowDown: BACK,
};

const element = (id) => document.getElementById(id);
const [canvas, slider] = [element("canvas"), element("slider")];
const settings = JSON.parse(element("settings").textContent);
const { path, names, up, focus, image } = settings;
const held = new Set(), pointers = new Map(); // keys; the last event of each finger or mouse
let scene, renderer, worker;
let camera, sorted; // the shown one, and that of the order; replaced, never changed
let place = 0, center = null; // on the path; the point to orbit, once one is needed
let playing = false, sorting = null, requested = false, lastTime = 0;

function report({ message }) {
  element("message").textContent = `The scene cannot be shown: ${message}.`;
}

/** Resolve once the browser has read all of the page. */
const isComplete = new Promise((resolve) => {
  if (document.readyState === "loading") addEventListener("DOMContentLoaded", resolve);
  else resolve();
});

/** Show the first camera as soon as the first part of the scene is there, and then the whole. */
async function start() {
  worker = new Worker(URL.createObjectURL(new Blob([element("worker").textContent])));
  worker.onerror = () => report({ message: "this browser refuses its worker" });
  renderer = new Renderer(canvas, settings);
  const parts = document.getElementsByClassName("spz");
  await load(parts[0]);
  slider.max = path.length - 1;
  element("controls").hidden = path.length < 2;
  show(0);
  await sort();
  resize(); // now, as the observer may come after the first click
  new ResizeObserver(resize).observe(canvas);
  element("message").hidden = true;
  await isComplete;
  if (!parts[1].textContent) return;
  await load(...parts);
  setCamera({ ...camera }); // to be sorted
  await sort();
}

/** Take these parts of the scene. */
async function load(...parts) {
  scene = await unpackAll(parts.map(({ textContent }) => textContent));
  renderer.setScene(scene);
  worker.postMessage({ positions: scene.positions });
}

/** Return the Gaussians in front of a camera, farthest first. */
function orderOf(camera) {
  const { port1, port2 } = new MessageChannel();
  worker.postMessage(camera, [port2]);
  return new Promise((resolve) => { port1.onmessage = ({ data }) => resolve(data); });
}

/** Sort for the shown camera, until it moves no more; what is there is drawn meanwhile. */
function sort() {
  return sorting ??= sortUntilStill().finally(() => { sorting = null; });
}

async function sortUntilStill() {
  while (sorted !== camera) {
    const next = camera;
    renderer.setOrder(await orderOf(next));
    sorted = next;
    request();
  }
}

/** Draw soon; nothing is drawn while nothing changes. */
function request() {
  if (!requested) requestAnimationFrame(frame);
  requested = true;
}

function frame(time) {
  requested = false;
  const seconds = Math.min((time - lastTime) / 1000, 0.1), last = path.length - 1;
  lastTime = time;
  if (playing) show(place + seconds * Math.max(PLAY_SPEED, last / MAX_PLAY_SECONDS));
  if (playing && place === last) play(false);
  for (const key of held) travel(KEYS[key].map((value) => value * seconds * distance()));
  sort();
  renderer.draw(camera);
}

const shownSize = () => [canvas.clientWidth, canvas.clientHeight];

function resize() {
  const [width, height] = shownSize();
  const ratio = Math.min(devicePixelRatio, 2, Math.sqrt(MAX_PIXELS / (width * height)));
  [canvas.width, canvas.height] = [width, height].map((side) => Math.round(ratio * side) || 1);
  renderer.draw(camera); // at once, as it is empty
}

function setCamera(next) {
  camera = next;
  request();
}

/** Show the camera at a place on the path: at place i, camera i. */
function show(next) {
  slider.value = place = Math.min(Math.max(next, 0), path.length - 1);
  const nearest = Math.round(place);
  element("name").textContent = names[nearest] ?? `${nearest + 1} / ${path.length}`;
  center = focus;
  setCamera(cameraAt(path, place));
}

function play(on) {
  playing = on;
  element("play").textContent = playing ? "❚❚" : "▶";
  if (playing && place === path.length - 1) show(0);
  request();
}

/** Return the point to orbit: at first the focus, else at the median depth of the image. */
function pivot() {
  const depths = center ? [] : renderer.depthMap(camera).depths.filter((depth) => depth > 0).sort();
  return center ??= move(camera, [0, 0, depths[depths.length >> 1] ?? 1]).position;
}

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

/** Return the middle of all pointers, and how far the first is from it. */
function spread() {
  const points = [...pointers.values()].map(({ clientX, clientY }) => [clientX, clientY]);
  const middle = points.reduce((sum, point) => add(sum, point, 1 / points.length), [0, 0]);
  return { middle, radius: Math.hypot(...add(points[0], middle, -1)) || 1 };
}

canvas.onpointerdown = (event) => {
  play(false);
  canvas.setPointerCapture(event.pointerId);
  pointers.set(event.pointerId, event);
};
canvas.onpointermove = (event) => {
  if (!pointers.has(event.pointerId)) return;
  const before = spread(), size = shownSize();
  pointers.set(event.pointerId, event);
  const after = spread(), [x, y] = add(after.middle, before.middle, -1);
  if (pointers.size > 1 || event.buttons & 2 || event.shiftKey) {
    const scale = -distance() / fit(camera.intrinsics, image, size).focal[0];
    travel([scale * x, scale * y, 0]);
    zoom(before.radius / after.radius);
  } else {
    const scale = -Math.PI / Math.min(...size);
    setCamera(orbit(camera, up, [scale * x, scale * y], pivot()));
  }
};
canvas.onpointerup = canvas.onpointercancel = (event) => pointers.delete(event.pointerId);
canvas.oncontextmenu = (event) => event.preventDefault();
canvas.onwheel = (event) => {
  event.preventDefault();
  play(false);
  const pixels = event.deltaY * (event.deltaMode ? 30 : 1);
  zoom(Math.exp(pixels * (event.ctrlKey ? 0.01 : 0.001))); // a pinch on a touch pad has Ctrl
};
canvas.ondblclick = ({ offsetX, offsetY }) => {
  const { depths, size } = renderer.depthMap(camera);
  const [x, y] = [offsetX, offsetY].map((value, k) => value / shownSize()[k] * size[k]);
  const depth = depths[(size[1] - 1 - Math.floor(y)) * size[0] + Math.floor(x)];
  const { focal, principal } = fit(camera.intrinsics, image, size);
  const ray = [(x - principal[0]) / focal[0], (y - principal[1]) / focal[1], 1];
  if (depth > 0) center = move(camera, ray.map((value) => depth * value)).position;
};
canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
canvas.addEventListener("webglcontextrestored", () => {
  renderer = new Renderer(canvas, settings);
  renderer.setScene(scene);
  setCamera({ ...camera });
});

onkeydown = (event) => {
  const elsewhere = event.target === slider || event.ctrlKey || event.metaKey || event.altKey;
  if (elsewhere || !(event.code in KEYS)) return;
  event.preventDefault();
  play(false);
  held.add(event.code);
  request();
};
onkeyup = (event) => held.delete(event.code);
onblur = () => held.clear();

const jump = (next) => { play(false); show(next); };
element("previous").onclick = () => jump(Math.ceil(place) - 1);
element("next").onclick = () => jump(Math.floor(place) + 1);
slider.oninput = () => jump(Number(slider.value));
element("play").onclick = () => play(!playing);

/** For other scripts, and tests. */
window.asysplat = {
  ready: start(),
  show: jump,
  camera: () => camera,
  /** Return the image of camera i in its own size, as a PNG in a data URL. */
  async picture(i) {
    const other = cameraAt(path, i);
    renderer.setOrder(await orderOf(other));
    sorted = other;
    [canvas.width, canvas.height] = image;
    renderer.draw(other);
    const url = canvas.toDataURL();
    resize();
    request();
    return url;
  },
};
window.asysplat.ready.catch(report);
