
// Unpack the Gaussians: SPZ (https://github.com/nianticlabs/spz) of version 3.

const HEADER = 16; // bytes

/** Return the Gaussians of several parts, one after the other. */
async function unpackAll(parts) {
  const unpacked = await Promise.all(parts.map(unpack));
  return Object.fromEntries(Object.entries(unpacked[0]).map(([name, { constructor }]) => {
    const arrays = unpacked.map((part) => part[name]);
    const all = new constructor(arrays.reduce((sum, { length }) => sum + length, 0));
    arrays.reduce((end, array) => (all.set(array, end), end + array.length), 0);
    return [name, all];
  }));
}

/** Return positions as floats, and everything else as its bytes. */
async function unpack(base64) {
  if (!("DecompressionStream" in window)) throw Error("this browser is too old to unpack it");
  const text = atob(base64);
  const packed = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) packed[i] = text.charCodeAt(i);
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  const buffer = await new Response(stream).arrayBuffer();
  const count = new DataView(buffer).getUint32(8, true);
  const [degree, fractionBits] = new Uint8Array(buffer, 12, 2);
  let end = HEADER;
  const next = (size) => new Uint8Array(buffer, end, (end += count * size) && count * size);
  const [fixed, alphas, colors, scales, rotations, sh] =
    [9, 1, 3, 3, 4, 3 * ((degree + 1) ** 2 - 1)].map(next);
  const positions = new Float32Array(3 * count);
  for (let i = 0; i < positions.length; i++) {
    // 24 bits with a sign, which a float holds exactly.
    const integer = fixed[3 * i] << 8 | fixed[3 * i + 1] << 16 | fixed[3 * i + 2] << 24;
    positions[i] = (integer >> 8) / 2 ** fractionBits;
  }
  const aligned = new Uint32Array(rotations.slice().buffer);
  return { positions, alphas, colors, scales, rotations: aligned, sh };
}
