
// Cameras: position; axes right, down and forward; intrinsics [fx, fy, cx, cy] in pixels.

const add = (a, b, factor = 1) => a.map((value, k) => value + factor * b[k]);
const dot = (a, b) => a.reduce((sum, value, k) => sum + value * b[k], 0);
const cross = (a, b) =>
  [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

/** Return the camera at a place on the path: at place i camera i, in between on a smooth curve,
 * a Catmull-Rom spline through the cameras' numbers (position, quaternion wxyz, intrinsics). */
function cameraAt(path, place) {
  const first = Math.floor(place), t = place - first, t2 = t * t, t3 = t * t2;
  const near = [-1, 0, 1, 2].map((k) => path[Math.min(Math.max(first + k, 0), path.length - 1)]);
  const weights = [2 * t2 - t - t3, 2 - 5 * t2 + 3 * t3, t + 4 * t2 - 3 * t3, t3 - t2];
  const numbers = path[0].map((_, k) => dot(weights, near.map((camera) => camera[k] / 2)));
  const norm = Math.hypot(...numbers.slice(3, 7));
  const [w, x, y, z] = numbers.slice(3, 7).map((value) => value / norm);
  const axes = [
    [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
    [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
    [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
  ];
  return { position: numbers.slice(0, 3), axes, intrinsics: numbers.slice(7) };
}

/** Return the intrinsics of a canvas that shows at least the camera's image, in its middle. */
function fit([fx, fy, cx, cy], image, canvas) {
  const scale = Math.min(canvas[0] / image[0], canvas[1] / image[1]);
  const principal = [cx, cy].map((c, k) => canvas[k] / 2 + scale * (c - image[k] / 2));
  return { focal: [scale * fx, scale * fy], principal };
}

/** Return a camera that is turned by an angle, in radians, around an axis through a point. */
function turn(camera, axis, angle, point) {
  const [sin, cos] = [Math.sin(angle), Math.cos(angle)];
  const turned = (v) => {
    const along = axis.map((value) => value * dot(axis, v) * (1 - cos));
    return add(add(along, v, cos), cross(axis, v), sin);
  };
  const position = add(point, turned(add(camera.position, point, -1)));
  return { ...camera, position, axes: camera.axes.map(turned) };
}

/** Turn a camera around the world's up, and then up or down, but not over the pole. */
function orbit(camera, up, [yaw, pitch], point) {
  const turned = turn(camera, up, yaw, point);
  const tilted = turn(turned, turned.axes[0], pitch, point);
  const [before, after] = [turned, tilted].map(({ axes }) => Math.abs(dot(axes[2], up)));
  return after < Math.max(0.99, before) ? tilted : turned;
}

/** Move a camera by distances along its axes. */
function move(camera, distances) {
  const steps = distances.map((distance, k) => camera.axes[k].map((value) => distance * value));
  return { ...camera, position: steps.reduce((sum, step) => add(sum, step), camera.position) };
}
