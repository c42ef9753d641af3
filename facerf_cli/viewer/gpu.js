// The relit image by WebGL2, in two passes: the maps are summed at their own size; then each pixel of the
// photo takes four fetches (detail, matte, background and that sum).

const VERTEX = `#version 300 es
const vec2 corners[3] = vec2[3](vec2(-1, -1), vec2(3, -1), vec2(-1, 3));
void main() { gl_Position = vec4(corners[gl_VertexID], 0, 1); }`;

const SUM = `#version 300 es
precision highp float;
uniform sampler2D maps;
uniform ivec2 tile;
uniform int columns, rank;
uniform vec3 sums[RANK];
out vec4 colour;
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  vec3 ratio = vec3(0);
  for (int k = 0; k < rank; k++) {
    vec3 stored = texelFetch(maps, at + tile * ivec2(k % columns, k / columns), 0).rgb;
    ratio += sums[k] * (stored * 255.0 - 128.0);
  }
  colour = vec4(ratio, 1);
}`;

const COMPOSE = `#version 300 es
precision highp float;
const float SHADE = ${SHADE};
uniform sampler2D detail, matte, background, ratio;
uniform vec4 box; // left, top, width, height in pixels of the photo
uniform float gain, keep;
uniform vec2 size;
out vec4 colour;
vec3 decoded(vec3 x) { return mix(x / 12.92, pow((x + 0.055) / 1.055, vec3(2.4)), step(0.04045, x)); }
vec3 encoded(vec3 x) {
  x = clamp(x, 0.0, 1.0);
  return mix(12.92 * x, 1.055 * pow(x, vec3(1.0 / 2.4)) - 0.055, step(0.0031308, x));
}
void main() {
  vec2 pixel = vec2(gl_FragCoord.x, size.y - gl_FragCoord.y);
  ivec2 at = ivec2(pixel);
  vec3 change = texture(ratio, (pixel - box.xy) / box.zw).rgb;
  vec3 grey = vec3(dot(change, vec3(1.0 / 3.0)));
  change = max(mix(grey, change, clamp(grey.r * gain / SHADE, 0.0, 1.0)), 0.0);
  vec3 person = decoded(texelFetch(detail, at, 0).rgb) * change * gain;
  float share = texelFetch(matte, at, 0).r;
  vec3 behind = decoded(texelFetch(background, at, 0).rgb);
  vec3 shown = mix(person, behind + share * person, keep);
  float alpha = max(share, keep);
  colour = vec4(encoded(shown) * alpha, alpha);
}`;

class GpuView {
  // Null where the browser cannot draw half floats.
  static create(canvas, data, images) {
    const gl = canvas.getContext("webgl2", { premultipliedAlpha: true, preserveDrawingBuffer: true, antialias: false });
    if (!gl || !gl.getExtension("EXT_color_buffer_float")) return null;
    const most = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    const vectors = gl.getParameter(gl.MAX_FRAGMENT_UNIFORM_VECTORS);
    const tooLarge = Object.values(images).some((image) => Math.max(image.width, image.height) > most);
    if (tooLarge || vectors < data.scales.length + 16) return null;
    return new GpuView(gl, data, images);
  }

  constructor(gl, data, images) {
    this.gl = gl;
    this.data = data;
    gl.canvas.width = data.size[0];
    gl.canvas.height = data.size[1];
    this.sum = program(gl, SUM.replace("RANK", data.scales.length));
    this.compose = program(gl, COMPOSE);
    this.textures = {};
    for (const name of ["maps", "detail", "matte", "background"]) this.textures[name] = texture(gl, images[name]);
    this.target = sumTarget(gl, data.mapSize);
    gl.disable(gl.BLEND);
  }

  // Draw under sums [K * 3] at an exposure, over the photo's background or over nothing.
  draw(sums, ev, withBackground) {
    const { gl, data } = this;
    const scaled = Float32Array.from(sums, (sum, i) => (sum * data.scales[Math.floor(i / 3)]) / 127);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target.buffer);
    gl.viewport(0, 0, ...data.mapSize);
    gl.useProgram(this.sum);
    this.bind(this.sum, { maps: this.textures.maps });
    gl.uniform2i(at(gl, this.sum, "tile"), ...data.tile);
    gl.uniform1i(at(gl, this.sum, "columns"), data.columns);
    gl.uniform1i(at(gl, this.sum, "rank"), data.scales.length);
    gl.uniform3fv(at(gl, this.sum, "sums"), scaled);
    gl.drawArrays(gl.TRIANGLES, 0, 3);

    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, ...data.size);
    gl.useProgram(this.compose);
    const { detail, matte, background } = this.textures;
    this.bind(this.compose, { detail, matte, background, ratio: this.target.texture });
    gl.uniform4f(at(gl, this.compose, "box"), ...data.box);
    gl.uniform2f(at(gl, this.compose, "size"), ...data.size);
    gl.uniform1f(at(gl, this.compose, "gain"), data.gain * 2 ** ev);
    gl.uniform1f(at(gl, this.compose, "keep"), withBackground ? 1 : 0);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  bind(program, textures) {
    Object.entries(textures).forEach(([name, texture], unit) => {
      this.gl.activeTexture(this.gl.TEXTURE0 + unit);
      this.gl.bindTexture(this.gl.TEXTURE_2D, texture);
      this.gl.uniform1i(at(this.gl, program, name), unit);
    });
  }
}

function at(gl, program, name) {
  return gl.getUniformLocation(program, name);
}

function program(gl, fragment) {
  const made = gl.createProgram();
  for (const [type, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made) || "no shader");
  return made;
}

function texture(gl, image) {
  const made = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, made);
  gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, image);
  filters(gl, gl.NEAREST);
  return made;
}

// The texture of half floats into which the maps are summed.
function sumTarget(gl, [width, height]) {
  const made = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, made);
  gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA16F, width, height);
  filters(gl, gl.LINEAR);
  const buffer = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, made, 0);
  return { texture: made, buffer };
}

function filters(gl, filter) {
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, filter);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, filter);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
}
