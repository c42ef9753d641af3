// The image: guide * sum over lights of weight * ratio (basis.py), by WebGL2 or by the processor; and its exposure.

const SHOULDER = 0.8; // brightest channel from which on the soft view bends a colour (image/colour.py)
const WHITENING = 0.3;
const BALL = 0.6; // its albedo
const PICTURES = ["guide", "plate", "matte", "photo"]; // as large as the view
const TEXTURES = [...PICTURES, "weights", "ratios", "sum"]; // each in the unit of its place here

const HEADER = `#version 300 es
precision highp float;
precision highp sampler2DArray;
`;
const VERTEX = `#version 300 es
void main() { gl_Position = vec4(ivec2(gl_VertexID & 1, gl_VertexID >> 1) * 4 - 1, 0, 1); }`;
const WEIGH = `${HEADER}
uniform sampler2DArray ratios;
uniform sampler2D weights;
out vec4 sum;
void main() {
  sum = vec4(0, 0, 0, 1);
  for (int light = 0; light < textureSize(weights, 0).x; light++) {
    vec3 weight = texelFetch(weights, ivec2(light, 0), 0).rgb;
    if (weight == vec3(0)) continue;
    vec3 root = texelFetch(ratios, ivec3(gl_FragCoord.xy, light), 0).rgb;
    sum.rgb += weight * root * root;
  }
}`;
const COMPOSE = `${HEADER}
uniform sampler2D guide, plate, matte, photo, sum;
uniform float white, keep; // linear value of the guide's white; 1 over the background, 0 over nothing
uniform vec3 original; // exposed strength of the photo's original light
out vec4 colour;
vec3 decoded(vec3 x) { return mix(x / 12.92, pow((x + 0.055) / 1.055, vec3(2.4)), step(0.04045, x)); }
vec3 encoded(vec3 x) {
  x = clamp(x, 0.0, 1.0);
  return mix(12.92 * x, 1.055 * pow(x, vec3(1.0 / 2.4)) - 0.055, step(0.0031308, x));
}
vec3 softened(vec3 x) {
  float brightest = max(max(x.r, x.g), x.b);
  if (brightest <= ${SHOULDER}) return x;
  float bent = 1.0 - ${1 - SHOULDER} * exp((${SHOULDER} - brightest) / ${1 - SHOULDER});
  return bent + (x * (bent / brightest) - bent) / (1.0 + ${WHITENING} * (brightest - bent));
}
void main() {
  vec2 size = vec2(textureSize(guide, 0));
  ivec2 at = ivec2(gl_FragCoord.x, size.y - gl_FragCoord.y);
  float share = texelFetch(matte, at, 0).r;
  float under = keep > 0.0 ? 1.0 : max(share, 0.001); // colours over nothing are not multiplied by the matte
  vec3 added = white * decoded(texelFetch(guide, at, 0).rgb) * texture(sum, (vec2(at) + 0.5) / size).rgb / under;
  vec3 background = decoded(texelFetch(plate, at, 0).rgb);
  vec3 person = share > 0.0 ? original * (decoded(texelFetch(photo, at, 0).rgb) - background) / under : vec3(0);
  vec3 held = keep * background + person;
  vec3 mixed = held + added, soft = softened(mixed);
  vec3 shown = original == vec3(0) ? mix(mixed, soft, keep > 0.0 ? share : 1.0) : soft + held - softened(held);
  float alpha = max(share, keep);
  colour = vec4(encoded(shown) * alpha, alpha);
}`;

class GpuView {
  // Null where the browser has no WebGL2 that draws into floats, or not as large.
  static create(canvas, data, images) {
    const gl = canvas.getContext("webgl2", { preserveDrawingBuffer: true, antialias: false });
    if (!gl?.getExtension("EXT_color_buffer_float")) return null;
    const wide = Math.max(...data.size) > gl.getParameter(gl.MAX_TEXTURE_SIZE);
    const deep = data.scales.length > gl.getParameter(gl.MAX_ARRAY_TEXTURE_LAYERS);
    return wide || deep ? null : new GpuView(gl, data, images);
  }

  constructor(gl, data, images) {
    Object.assign(this, { gl, data });
    [gl.canvas.width, gl.canvas.height] = data.size;
    [this.weigh, this.compose] = [this.program(WEIGH), this.program(COMPOSE)];
    gl.uniform1f(gl.getUniformLocation(this.compose, "white"), data.white);
    gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
    for (const name of PICTURES) {
      this.texture(name, gl.NEAREST);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, images[name]);
    }
    this.texture("weights", gl.NEAREST);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32F, data.scales.length, 1);
    this.texture("ratios", gl.NEAREST, gl.TEXTURE_2D_ARRAY);
    gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, gl.RGBA8, ...data.small, data.scales.length);
    const sum = this.texture("sum", gl.LINEAR);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA16F, ...data.small);
    this.buffer = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.buffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, sum, 0);
  }

  // Take the bytes of a light's ratio [h, w, 4].
  add(light, pixels) {
    const { gl, data } = this;
    gl.activeTexture(gl.TEXTURE0 + TEXTURES.indexOf("ratios"));
    gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, 0, 0, light, ...data.small, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
  }

  // Draw the sum by weights [lights * 3] and the photo's original light [3], over its background or over nothing.
  draw(weights, original, withBackground) {
    const { gl, data } = this;
    const texels = Float32Array.from({ length: 4 * data.scales.length }, (_, i) => weights[3 * (i >> 2) + Math.min(2, i % 4)]);
    gl.activeTexture(gl.TEXTURE0 + TEXTURES.indexOf("weights"));
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, data.scales.length, 1, gl.RGBA, gl.FLOAT, texels);
    for (const [program, buffer, size] of [[this.weigh, this.buffer, data.small], [this.compose, null, data.size]]) {
      gl.useProgram(program);
      gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
      gl.viewport(0, 0, ...size);
      if (!buffer) {
        gl.uniform1f(gl.getUniformLocation(program, "keep"), withBackground ? 1 : 0);
        gl.uniform3f(gl.getUniformLocation(program, "original"), ...original);
      }
      gl.drawArrays(gl.TRIANGLES, 0, 3);
    }
  }

  texture(name, filter, kind = this.gl.TEXTURE_2D) {
    const { gl } = this;
    const made = gl.createTexture();
    gl.activeTexture(gl.TEXTURE0 + TEXTURES.indexOf(name));
    gl.bindTexture(kind, made);
    for (const end of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(kind, end, filter);
    for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(kind, side, gl.CLAMP_TO_EDGE);
    return made;
  }

  program(fragment) {
    const { gl } = this;
    const made = gl.createProgram();
    for (const [type, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(type);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(made, shader);
    }
    gl.linkProgram(made);
    if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made) || "no shader");
    gl.useProgram(made);
    TEXTURES.forEach((name, unit) => gl.uniform1i(gl.getUniformLocation(made, name), unit));
    return made;
  }
}

// The sum by weights [images * 3] of images whose bytes [n * 4] are square roots.
function weighed(images, weights) {
  const sum = new Float32Array(images[0].length);
  images.forEach((roots, light) => {
    const rgb = [0, 1, 2].map((c) => weights[3 * light + c] / 255 ** 2);
    if (!rgb.some(Boolean)) return;
    for (let i = 0; i < sum.length; i += 4) for (let c = 0; c < 3; c++) sum[i + c] += rgb[c] * roots[i + c] ** 2;
  });
  return sum;
}

function softened(colour) {
  const brightest = Math.max(...colour);
  if (brightest <= SHOULDER) return colour;
  const bent = 1 - (1 - SHOULDER) * Math.exp((SHOULDER - brightest) / (1 - SHOULDER));
  return colour.map((value) => bent + ((value * bent) / brightest - bent) / (1 + WHITENING * (brightest - bent)));
}

// The same by the processor, as small as the ratios.
class CanvasView {
  constructor(canvas, data, images) {
    Object.assign(this, { data, ratios: [], context: canvas.getContext("2d") });
    [canvas.width, canvas.height] = data.small;
    for (const name of PICTURES) this[name] = pixelsOf(images[name], ...data.small);
  }

  add(light, pixels) {
    this.ratios[light] = pixels;
  }

  draw(weights, original, withBackground) {
    const [shown, sum] = [this.context.createImageData(...this.data.small), weighed(this.ratios, weights)];
    for (let at = 0; at < sum.length; at += 4) {
      const share = this.matte[at] / 255;
      const under = withBackground ? 1 : Math.max(share, 0.001);
      const held = original.map((value, c) => {
        const background = decoded(this.plate[at + c] / 255);
        const person = share && (value * (decoded(this.photo[at + c] / 255) - background)) / under;
        return withBackground ? background + person : person;
      });
      const mixed = held.map((value, c) => value + (this.data.white * decoded(this.guide[at + c] / 255) * sum[at + c]) / under);
      const [soft, bent, part] = [softened(mixed), softened(held), withBackground ? share : 1];
      const pixel = soft.map((value, c) => original.some(Boolean) ? value + held[c] - bent[c] : mixed[c] + part * (value - mixed[c]));
      shown.data.set([...pixel.map((value) => 255 * encoded(value)), withBackground ? 255 : 255 * share], at);
    }
    this.context.putImageData(shown, 0, 0);
  }
}

// A grey ball seen from the front, matte, under weights [lights * 3] of lights, and of ambient fill.
function drawBall(canvas, lights, weights) {
  const { width } = canvas;
  const context = canvas.getContext("2d");
  const shown = context.createImageData(width, width);
  const on = lights.map((light, i) => [light, weights.subarray(3 * i, 3 * i + 3)]).filter(([, rgb]) => rgb.some(Boolean));
  const ambient = [...weights.subarray(3 * lights.length)].map((value) => (BALL * value) / 4);
  for (let i = 0; i < width * width; i++) {
    const [x, y] = [(2 * (i % width) + 1) / width - 1, 1 - (2 * Math.floor(i / width) + 1) / width];
    if (x * x + y * y > 1) continue;
    const normal = [x, y, Math.sqrt(1 - x * x - y * y)];
    const sum = ambient.length ? [...ambient] : [0, 0, 0];
    for (const [light, rgb] of on) {
      const cosine = BALL * Math.max(0, dot(normal, light));
      sum[0] += cosine * rgb[0];
      sum[1] += cosine * rgb[1];
      sum[2] += cosine * rgb[2];
    }
    shown.data.set([...softened(sum).map((value) => 255 * encoded(value)), 255], 4 * i);
  }
  context.putImageData(shown, 0, 0);
}

async function imageOf(base64, type) {
  const image = new Image();
  image.src = `data:image/${type};base64,${base64}`;
  await image.decode();
  return image;
}

// The bytes [R, G, B, A, ...] of an image at a size.
function pixelsOf(image, width, height) {
  const canvas = Object.assign(document.createElement("canvas"), { width, height });
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.drawImage(image, 0, 0, width, height);
  return context.getImageData(0, 0, width, height).data;
}

// Pixels that are the brightest of a total, with an image of their square roots, a row a light.
async function brightestOf({ roots, scales, shares, total }) {
  const image = await imageOf(roots, "webp");
  const bytes = pixelsOf(image, image.naturalWidth, scales.length);
  return { roots: groups(bytes, 4 * image.naturalWidth), scales, shares: groups(floatsOf(shares), 3), total };
}

// The percentile of luminance of all of them under weights [lights * 3].
function percentileOf({ roots, scales, shares, total }, weights, percent) {
  if (!shares.length) return 0;
  const sums = groups(weighed(roots, scaled(weights, scales)), 4);
  const values = Float32Array.from(shares, (share, i) => dot(share, sums[i])).sort();
  const at = Math.max(0, values.length - 1 - (total - 1) * (1 - percent / 100));
  const [low, high] = [values[Math.floor(at)], values[Math.ceil(at)]];
  return low + (at - Math.floor(at)) * (high - low);
}

// EV to two decimals under weights [lights * 3], as of `facerf relight --exposure auto`: the face as in the photo.
function automaticEv({ face, person, plate, target, mostOverFront, personPercentile }, weights) {
  const body = percentileOf(person, weights, personPercentile);
  const skin = plate ? face.reduce((sum, value, i) => sum + value * weights[i], 0) : target;
  if (Math.min(skin, body, plate ? plate[0] : 1) < 1e-9) return 0;
  const gain = plate ? Math.min(plate[0] / skin, (2 * Math.max(1, plate[1])) / body) : target / body;
  const strength = groups(weights, 3).reduce((sum, rgb) => sum + luminance(rgb), 0);
  return Math.round(100 * Math.min(Math.log2(gain), mostOverFront - Math.log2(strength))) / 100;
}
