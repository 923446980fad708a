
// Sort the Gaussians in front of a camera, from far to near, in a thread of its own: two stable
// counting sorts, by the lower and then the upper half of the depth's 32 bits. The order is exact,
// as positive floats compare like their bits.

const DIGITS = 1 << 16;
let positions, depths, bits;

onmessage = ({ data, ports }) => {
  if (data.positions) {
    positions = data.positions;
    depths = new Float32Array(positions.length / 3);
    bits = new Uint32Array(depths.buffer);
  } else {
    const order = sort(data.position, data.axes[2]);
    ports[0].postMessage(order, [order.buffer]);
  }
};

/** Return the indices of the Gaussians in front of a camera, farthest first. */
function sort([x, y, z], [forwardX, forwardY, forwardZ]) {
  const indices = new Uint32Array(depths.length);
  let count = 0;
  // From the last on: of equal depths, the first index is in front, as in asysplat.render.
  for (let i = depths.length - 1; i >= 0; i--) {
    depths[i] = (positions[3 * i] - x) * forwardX
      + (positions[3 * i + 1] - y) * forwardY + (positions[3 * i + 2] - z) * forwardZ;
    if (depths[i] > 0) indices[count++] = i;
  }
  return countingSort(countingSort(indices.subarray(0, count), 0), 16);
}

/** Sort indices by 16 bits of their depths, greatest first. */
function countingSort(indices, shift) {
  const starts = new Uint32Array(DIGITS), sorted = new Uint32Array(indices.length);
  for (const i of indices) starts[(bits[i] >>> shift) % DIGITS]++;
  for (let digit = DIGITS - 1, end = 0; digit >= 0; digit--) {
    [starts[digit], end] = [end, end + starts[digit]];
  }
  for (const i of indices) sorted[starts[(bits[i] >>> shift) % DIGITS]++] = i;
  return sorted;
}
