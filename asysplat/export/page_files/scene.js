
// The Gaussians, from SPZ (https://github.com/nianticlabs/spz) of version 3.

const HEADER = 16; // bytes

/** Unpack SPZ in base64: positions as floats, everything else as its bytes. */
async function unpack(base64) {
  if (!("DecompressionStream" in window)) throw Error("this browser is too old to unpack it");
  const text = atob(base64);
  const packed = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) packed[i] = text.charCodeAt(i);
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  const buffer = await new Response(stream).arrayBuffer();
  const header = new DataView(buffer, 0, HEADER);
  const [count, degree, fractionBits] =
    [header.getUint32(8, true), header.getUint8(12), header.getUint8(13)];
  let end = HEADER;
  const next = (size) => new Uint8Array(buffer, end, (end += count * size) && count * size);
  const [fixed, alphas, colors, scales] = [9, 1, 3, 3].map(next);
  const rotations = new Uint32Array(next(4).slice().buffer); // aligned
  const sh = next(3 * ((degree + 1) ** 2 - 1));
  const positions = new Float32Array(3 * count);
  for (let i = 0; i < positions.length; i++) {
    // 24 bits with a sign, which a float holds exactly.
    const integer = fixed[3 * i] << 8 | fixed[3 * i + 1] << 16 | fixed[3 * i + 2] << 24;
    positions[i] = (integer >> 8) / 2 ** fractionBits;
  }
  return { count, degree, positions, alphas, colors, scales, rotations, sh };
}

/** Sort the Gaussians by depth in another thread. */
class Sorter {
  constructor(positions, near) {
    const source = new Blob([document.getElementById("worker").textContent]);
    const url = URL.createObjectURL(source);
    this.waiting = [];
    this.worker = new Worker(url);
    this.worker.onmessage = ({ data }) => this.waiting.shift().resolve(data);
    this.worker.onerror = () => this.waiting.shift().reject(Error("the sorting thread failed"));
    this.worker.postMessage({ positions, near });
  }

  /** Return the indices of the Gaussians in front of a camera, farthest first. */
  sort({ position, axes }) {
    return new Promise((resolve, reject) => {
      this.waiting.push({ resolve, reject });
      this.worker.postMessage({ position, forward: axes[2] });
    });
  }
}
