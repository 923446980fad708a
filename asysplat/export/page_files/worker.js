
// Sort the Gaussians in front of a camera, from far to near, in a thread of its own.
//
// Two stable counting sorts, by the lower and then the upper half of the depth's 32 bits, give the
// exact order: positive floats compare as their bits do.

const DIGITS = 1 << 16;
const starts = new Uint32Array(DIGITS);
let positions, near, depths, bits, indices, partly;

onmessage = ({ data, ports }) => {
  if (data.positions) {
    ({ positions, near } = data);
    depths = new Float32Array(positions.length / 3);
    bits = new Uint32Array(depths.buffer);
    indices = new Uint32Array(depths.length);
    partly = new Uint32Array(depths.length);
  } else {
    ports[0].postMessage(sort(data.position, data.axes[2]));
  }
};

/** Return the indices of the Gaussians in front of the near plane, farthest first. */
function sort([x, y, z], [forwardX, forwardY, forwardZ]) {
  let count = 0;
  // From the last on: of equal depths, the first index is in front, as in asysplat.render.
  for (let i = depths.length - 1; i >= 0; i--) {
    depths[i] = (positions[3 * i] - x) * forwardX
      + (positions[3 * i + 1] - y) * forwardY + (positions[3 * i + 2] - z) * forwardZ;
    if (depths[i] > near) indices[count++] = i;
  }
  const order = new Uint32Array(count);
  countingSort(indices, partly, count, 0);
  countingSort(partly, order, count, 16);
  return order;
}

/** Sort `count` indices by 16 bits of their depth, greatest first. */
function countingSort(source, target, count, shift) {
  starts.fill(0);
  for (let i = 0; i < count; i++) starts[(bits[source[i]] >>> shift) % DIGITS]++;
  for (let digit = DIGITS - 1, end = 0; digit >= 0; digit--) {
    [starts[digit], end] = [end, end + starts[digit]];
  }
  for (let i = 0; i < count; i++) {
    target[starts[(bits[source[i]] >>> shift) % DIGITS]++] = source[i];
  }
}
