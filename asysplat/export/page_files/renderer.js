
// The formulas of asysplat.render (asysplat/rendering/reference/project.py), in WebGL 2. Python
// defines the names in capitals.

const WIDTH = 2048; // texels in a row, which every WebGL 2 allows
const DEPTH_MAP = 128; // pixels along the longer side

const VERTEX_SHADER = `
uniform highp sampler2D positions;
uniform highp usampler2D alphas, colors, scales, rotations, sh, order;
uniform mat3 axes; // columns: right, down, forward
uniform vec3 position;
uniform vec2 focal, principal, size;
uniform bool drawDepth;
out vec2 whitened;
flat out vec4 color;

ivec2 place(int i) { return ivec2(i % ${WIDTH}, i / ${WIDTH}); }
uvec3 fetch(highp usampler2D data, int i) { return texelFetch(data, place(i), 0).rgb; }

// The smallest three components have 9 bits and a sign each, the largest has its index.
mat3 rotation(uint bits) {
  vec4 q = vec4(0);
  int largest = int(bits >> 30), shift = 20;
  for (int k = 0; k < 4; k++) {
    if (k == largest) continue;
    uint number = bits >> shift & 1023u;
    q[k] = float(number & 511u) / (511.0 * sqrt(2.0)) * (number > 511u ? -1.0 : 1.0);
    shift -= 10;
  }
  q[largest] = sqrt(max(1.0 - dot(q, q), 0.0));
  q = normalize(q);
  vec3 a = 2.0 * q.x * q.xyz, b = 2.0 * q.y * q.xyz, w = 2.0 * q.w * q.xyz;
  float zz = 2.0 * q.z * q.z;
  return mat3(
    1.0 - b.y - zz, a.y + w.z, a.z - w.y,
    a.y - w.z, 1.0 - a.x - zz, b.z + w.x,
    a.z + w.y, b.z - w.x, 1.0 - a.x - b.y);
}

vec3 shColor(int i, vec3 d) {
  float xx = d.x * d.x, yy = d.y * d.y, zz = d.z * d.z;
  float basis[15] = float[](
    -Y1 * d.y, Y1 * d.z, -Y1 * d.x,
    Y2 * d.x * d.y, -Y2 * d.y * d.z, Y2_0 * (2.0 * zz - xx - yy), -Y2 * d.x * d.z,
    0.5 * Y2 * (xx - yy),
    -Y3_3 * d.y * (3.0 * xx - yy), Y3_2 * d.x * d.y * d.z, -Y3_1 * d.y * (4.0 * zz - xx - yy),
    Y3_0 * d.z * (2.0 * zz - 3.0 * xx - 3.0 * yy), -Y3_1 * d.x * (4.0 * zz - xx - yy),
    0.5 * Y3_2 * d.z * (xx - yy), -Y3_3 * d.x * (xx - 3.0 * yy));
  vec3 sum = 0.5 + SH_C0 / COLOR_FACTOR * (vec3(fetch(colors, i)) / 255.0 - 0.5);
  for (int k = 0; k < SH_COUNT; k++) {
    sum += basis[k] * (vec3(fetch(sh, SH_COUNT * i + k)) / 128.0 - 1.0);
  }
  return max(sum, 0.0);
}

void main() {
  gl_Position = vec4(0, 0, 2, 1); // outside: culled
  int i = int(fetch(order, gl_VertexID / 3).r);
  vec3 offset = texelFetch(positions, place(i), 0).rgb - position;
  vec3 local = offset * axes;
  if (!(local.z > NEAR)) return;

  vec2 tangents = local.xy / local.z, margin = FRUSTUM_MARGIN * size;
  vec2 low = (-principal - margin) / focal, high = (size - principal + margin) / focal;
  vec2 clamped = clamp(tangents, low, high);
  mat3 turn = rotation(fetch(rotations, i).r);
  vec3 scale = exp(vec3(fetch(scales, i)) / 16.0 - 10.0);
  vec3 rowX = focal.x / local.z * (axes[0] - clamped.x * axes[2]) * turn * scale;
  vec3 rowY = focal.y / local.z * (axes[1] - clamped.y * axes[2]) * turn * scale;

  // The covariance's inverse is the square of the whitening (a, b; 0, c).
  float xx = dot(rowX, rowX), xy = dot(rowX, rowY), varY = dot(rowY, rowY) + EPS2D;
  vec3 normal = cross(rowX, rowY * inversesqrt(varY));
  float minors = dot(normal, normal), determinant = minors + EPS2D * (1.0 + xx / varY);
  float a = inversesqrt(determinant), b = -a * xy / varY, c = inversesqrt(varY);
  float opacity = float(fetch(alphas, i).r) / 255.0;
  if (ANTIALIASED == 1) opacity *= sqrt(max(minors / determinant, COMPENSATION_MIN));
  if (!(opacity >= ALPHA_MIN && a > 0.0)) return;

  // A triangle around the ellipse where alpha >= ALPHA_MIN, with a margin for rounding.
  float radius = sqrt(2.0 * log(opacity / ALPHA_MIN)) + 0.01;
  const float SIDE = sqrt(3.0);
  whitened = radius * vec2[](vec2(0, 2), vec2(-SIDE, -1), vec2(SIDE, -1))[gl_VertexID % 3];
  float y = whitened.y / c, x = (whitened.x - b * y) / a;
  vec2 pixel = tangents * focal + principal + vec2(x, y);
  gl_Position = vec4((2.0 * pixel / size - 1.0) * vec2(1, -1), 0, 1);
  color = vec4(drawDepth ? vec3(local.z) : shColor(i, normalize(offset)), opacity);
}`;

const FRAGMENT_SHADER = `
in vec2 whitened;
flat in vec4 color;
out vec4 result;

void main() {
  float alpha = min(color.a * exp(-0.5 * dot(whitened, whitened)), ALPHA_MAX);
  if (alpha < ALPHA_MIN) discard;
  result = vec4(color.rgb, alpha);
}`;

class Renderer {
  /** Prepare a canvas: compile the shaders, create the textures. */
  constructor(canvas, { defines, background, image }) {
    const gl = canvas.getContext("webgl2", { antialias: false, depth: false });
    if (!gl) throw Error("this browser has no WebGL 2, or it is switched off");
    // In 8 bits, most of what faint splats contribute would be lost, and depths end at 1.
    const float = gl.getExtension("EXT_color_buffer_float")
      ?? gl.getExtension("EXT_color_buffer_half_float");
    Object.assign(this, { gl, canvas, background, image, float });
    this.compile(`#version 300 es\nprecision highp float;\n${defines}`);

    const bytes = [3, gl.RGB8UI, gl.RGB_INTEGER, gl.UNSIGNED_BYTE];
    const integers = [1, gl.R32UI, gl.RED_INTEGER, gl.UNSIGNED_INT];
    this.formats = {
      positions: [3, gl.RGB32F, gl.RGB, gl.FLOAT],
      alphas: [1, gl.R8UI, gl.RED_INTEGER, gl.UNSIGNED_BYTE],
      colors: bytes, scales: bytes, sh: bytes, rotations: integers, order: integers,
    };
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    Object.keys(this.formats).forEach((name, unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
      gl.uniform1i(this.uniform(name), unit);
    });

    const target = gl.createRenderbuffer();
    this.framebuffer = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.framebuffer);
    gl.bindRenderbuffer(gl.RENDERBUFFER, target);
    gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.RENDERBUFFER, target);
    gl.enable(gl.BLEND);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  }

  compile(header) {
    const gl = this.gl, program = this.program = gl.createProgram();
    for (const [type, source] of [["VERTEX", VERTEX_SHADER], ["FRAGMENT", FRAGMENT_SHADER]]) {
      const shader = gl.createShader(gl[`${type}_SHADER`]);
      gl.shaderSource(shader, header + source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) {
      const logs = gl.getAttachedShaders(program).map((shader) => gl.getShaderInfoLog(shader));
      throw Error(`the graphics driver refuses the shaders (${logs.join("")})`);
    }
    gl.useProgram(program);
  }

  uniform(name) { return this.gl.getUniformLocation(this.program, name); }

  /** Write data to the texture of this name, row by row. */
  write(name, data) {
    const gl = this.gl, [channels, ...format] = this.formats[name];
    const rows = Math.ceil(data.length / channels / WIDTH);
    if (rows > gl.getParameter(gl.MAX_TEXTURE_SIZE)) {
      throw Error("it has more Gaussians than this device can hold");
    }
    const padded = new data.constructor(rows * WIDTH * channels);
    padded.set(data);
    gl.activeTexture(gl.TEXTURE0 + Object.keys(this.formats).indexOf(name));
    gl.texImage2D(gl.TEXTURE_2D, 0, format[0], WIDTH, rows, 0, format[1], format[2], padded);
  }

  /** Write the Gaussians to textures. */
  setScene(scene) {
    for (const name in scene) this.write(name, scene[name]);
  }

  /** Set the Gaussians to draw, farthest first. */
  setOrder(order) {
    this.count = order.length;
    this.write("order", order);
  }

  /** Draw a camera's image in the size of the canvas. */
  draw(camera) {
    const gl = this.gl, size = [this.canvas.width, this.canvas.height];
    this.composite(camera, size, [...this.background, 1], false);
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, null);
    gl.blitFramebuffer(0, 0, ...size, 0, 0, ...size, gl.COLOR_BUFFER_BIT, gl.NEAREST);
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, this.framebuffer);
  }

  /** Compute a small image of depths, bottom row first; NaN where there is nothing. */
  depthMap(camera) {
    const gl = this.gl, sides = [this.canvas.width, this.canvas.height];
    const size = sides.map((side) => Math.ceil(DEPTH_MAP * side / Math.max(...sides)));
    this.composite(camera, size, [0, 0, 0, 0], true);
    const [type, Pixels] = this.float ? [gl.FLOAT, Float32Array] : [gl.UNSIGNED_BYTE, Uint8Array];
    const pixels = new Pixels(4 * size[0] * size[1]);
    gl.readPixels(0, 0, ...size, gl.RGBA, type, pixels);
    const depths = new Float32Array(size[0] * size[1]);
    return { size, depths: depths.map((_, i) => pixels[4 * i] / pixels[4 * i + 3]) };
  }

  /** Composite all splats, back to front, in the framebuffer. */
  composite({ position, axes, intrinsics }, size, background, drawDepth) {
    const gl = this.gl, pairs = { ...fit(intrinsics, this.image, size), size };
    if (String(size) !== this.allocated) {
      gl.renderbufferStorage(gl.RENDERBUFFER, this.float ? gl.RGBA16F : gl.RGBA8, ...size);
      this.allocated = String(size);
    }
    gl.viewport(0, 0, ...size);
    gl.clearColor(...background);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.uniformMatrix3fv(this.uniform("axes"), false, axes.flat());
    gl.uniform3fv(this.uniform("position"), position);
    for (const name in pairs) gl.uniform2fv(this.uniform(name), pairs[name]);
    gl.uniform1i(this.uniform("drawDepth"), Number(drawDepth));
    gl.drawArrays(gl.TRIANGLES, 0, 3 * this.count);
  }
}
