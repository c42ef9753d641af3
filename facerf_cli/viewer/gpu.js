// The relit image by WebGL2: each pixel of the photo takes the light of the maps around it (whole_person.py), and in
// the face that of its texture (composite.py).

const VERTEX = `#version 300 es
const vec2 corners[3] = vec2[3](vec2(-1, -1), vec2(3, -1), vec2(-1, 3));
void main() { gl_Position = vec4(corners[gl_VertexID], 0, 1); }`;

const COMPOSE = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2DArray;
precision highp usampler2D;
uniform sampler2D photo, fringe, matte, change;
uniform sampler2DArray lines, lit, face;
uniform usampler2D window;
uniform ivec4 place; // left, top, width, height of the face in the photo
uniform vec3 square; // left, top, side of the square of the maps
uniform vec2 size, gainRange;
uniform vec3 meanChange;
uniform float guideGain, personExposure, exposure, detailFloor, keep;
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
  return mix(vec3(bent), x * (bent / brightest), 1.0 / (1.0 + ${WHITENING} * (brightest - bent)));
}
vec3 wholePerson(vec3 own, vec2 at) {
  vec3 guide = floor(encoded(own * guideGain) * 255.0 + 0.5) / 255.0;
  vec4 r = texture(lines, vec3(at, 0)), g = texture(lines, vec3(at, 1)), b = texture(lines, vec3(at, 2));
  vec4 rest = texture(lines, vec3(at, 3));
  vec3 gain = vec3(dot(r.rgb, guide) + r.a, dot(g.rgb, guide) + g.a, dot(b.rgb, guide) + b.a);
  vec3 albedo = own / personExposure * exp(clamp(gain, gainRange.x, gainRange.y)) + rest.rgb;
  float finer = clamp(dot(albedo, vec3(1.0 / 3.0)) / max(rest.a, 1e-4), ${STRAND_RANGE[0]}, ${STRAND_RANGE[1]}.0);
  float strands = texture(lines, vec3(at, 4)).r;
  vec3 shine = texture(lit, vec3(at, 1)).rgb * mix(1.0, finer, strands);
  vec3 radiance = (albedo * texture(lit, vec3(at, 0)).rgb + shine) * exposure;
  vec2 edge = abs(2.0 * at - 1.0);
  float inside = clamp((1.0 - max(edge.x, edge.y)) / ${FEATHER}, 0.0, 1.0);
  float side = float(textureSize(lit, 0).x);
  vec2 block = clamp(at * side, 0.5, side - 0.5) / ${CHANGE_BLOCK}.0 + 1.0;
  vec3 beyond = texture(change, block / vec2(textureSize(change, 0))).rgb;
  return mix(own * beyond, radiance, inside);
}
vec3 withFace(vec3 person, vec3 own, uvec4 seen) {
  vec2 uv = vec2(seen.xy) / 65535.0;
  vec4 source = texture(face, vec3(uv, 2));
  vec3 skin = texture(face, vec3(uv, 0)).rgb;
  vec3 floored = vec3(detailFloor);
  vec3 brighter = skin * (own + floored) / (source.rgb + floored) + meanChange * floored * (own - source.rgb) / (source.rgb + floored);
  float lightness = dot(own, vec3(${LUMINANCE}));
  vec3 around = source.rgb * lightness / max(dot(source.rgb, vec3(${LUMINANCE})), 1e-8);
  vec3 steady = mix(own, around, max(1.0 - lightness / (${NOISY}.0 * detailFloor), 0.0));
  vec3 darker = skin * (steady / max(source.rgb, 1e-8) + (own - steady) / (source.rgb + floored));
  vec3 relit = mix(darker, brighter, step(source.rgb, own));
  relit += source.a * (texture(face, vec3(uv, 1)).rgb * own - relit);
  return mix(person, relit, float(seen.z) / 65535.0);
}
void main() {
  vec2 pixel = vec2(gl_FragCoord.x, size.y - gl_FragCoord.y);
  ivec2 at = ivec2(pixel);
  vec3 plate = decoded(texelFetch(photo, at, 0).rgb);
  float share = texelFetch(matte, at, 0).r;
  vec3 own = share > 0.0 && share < 1.0 ? decoded(texelFetch(fringe, at, 0).rgb) : plate;
  vec3 person = wholePerson(own, (pixel - square.xy) / square.z);
  ivec2 inFace = at - place.xy;
  if (all(greaterThanEqual(inFace, ivec2(0))) && all(lessThan(inFace, place.zw))) {
    uvec4 seen = texelFetch(window, inFace, 0);
    if (seen.z > 0u) person = withFace(person, own, seen);
  }
  vec3 mixed = plate - share * own + share * person;
  vec3 shown = mix(softened(person), mixed + share * (softened(mixed) - mixed), keep);
  float alpha = max(share, keep);
  colour = vec4(encoded(shown) * alpha, alpha);
}`;

class GpuView {
  // Null where the browser cannot blend textures of floats.
  static create(canvas, data, arrays, images) {
    const gl = canvas.getContext("webgl2", { premultipliedAlpha: true, preserveDrawingBuffer: true, antialias: false });
    if (!gl || Math.max(...data.size) > gl.getParameter(gl.MAX_TEXTURE_SIZE)) return null;
    return new GpuView(gl, data, arrays, images);
  }

  constructor(gl, data, arrays, images) {
    this.gl = gl;
    this.data = data;
    [gl.canvas.width, gl.canvas.height] = data.size;
    this.format = gl.getExtension("OES_texture_float_linear") ? gl.RGBA32F : gl.RGBA16F;
    this.compose = program(gl, COMPOSE);
    this.textures = {};
    for (const name of ["photo", "fringe", "matte"]) this.textures[name] = this.image(images[name]);
    const { side } = data.person;
    this.side = side;
    this.facePx = Math.sqrt(arrays.faceTexture.length / 3);
    this.textures.lines = this.planes(linesOf(arrays, side), side, 5);
    this.source = [arrays.faceTexture, arrays.ownDetail];
    this.textures.window = this.window(arrays.window, data.window);
    gl.disable(gl.BLEND);
  }

  // Take the light of all pixels: `lit` is { lit, change, texture, around, mean, gain }.
  light({ lit, change, texture, around, mean, gain }) {
    const { gl, side, facePx } = this;
    for (const name of ["lit", "change", "face"]) gl.deleteTexture(this.textures[name]);
    this.textures.lit = this.planes([...layersOf(lit, 2, side, gain)], side, 2);
    const blocks = Math.sqrt(change.length / 3);
    this.textures.change = this.planes([...layersOf(change, 1, blocks, gain)], blocks, 1, gl.TEXTURE_2D);
    const layers = [...layersOf(texture, 1, facePx, gain), ...layersOf(around, 1, facePx, gain)];
    this.textures.face = this.planes([...layers, interleaved(...this.source, facePx)], facePx, 3);
    this.mean = mean.map((value) => value * gain);
  }

  // Draw over the photo's background or over nothing.
  draw(withBackground) {
    const { gl, data, compose } = this;
    gl.viewport(0, 0, ...data.size);
    gl.useProgram(compose);
    Object.entries(this.textures).forEach(([name, made], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(["lines", "lit", "face"].includes(name) ? gl.TEXTURE_2D_ARRAY : gl.TEXTURE_2D, made);
      gl.uniform1i(at(gl, compose, name), unit);
    });
    const { person } = data;
    gl.uniform4i(at(gl, compose, "place"), ...data.window);
    gl.uniform3f(at(gl, compose, "square"), ...person.square);
    gl.uniform2f(at(gl, compose, "size"), ...data.size);
    gl.uniform2f(at(gl, compose, "gainRange"), ...person.gainRange);
    gl.uniform3f(at(gl, compose, "meanChange"), ...this.mean);
    for (const name of ["guideGain", "personExposure", "exposure", "detailFloor"]) {
      gl.uniform1f(at(gl, compose, name), person[name]);
    }
    gl.uniform1f(at(gl, compose, "keep"), withBackground ? 1 : 0);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  image(image) {
    const { gl } = this;
    const made = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, made);
    gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, image);
    filters(gl, gl.TEXTURE_2D, gl.NEAREST);
    return made;
  }

  // Layers of RGBA [side, side, 4] as a texture that is sampled between its pixels.
  planes(layers, side, count, kind = this.gl.TEXTURE_2D_ARRAY) {
    const { gl } = this;
    const made = gl.createTexture();
    gl.bindTexture(kind, made);
    if (kind === gl.TEXTURE_2D) {
      gl.texImage2D(kind, 0, this.format, side, side, 0, gl.RGBA, gl.FLOAT, layers[0]);
    } else {
      gl.texStorage3D(kind, 1, this.format, side, side, count);
      layers.forEach((layer, i) => gl.texSubImage3D(kind, 0, 0, 0, i, side, side, 1, gl.RGBA, gl.FLOAT, layer));
    }
    filters(gl, kind, gl.LINEAR);
    return made;
  }

  window(planes, [, , width, height]) {
    const { gl } = this;
    const area = width * height;
    const texels = new Uint16Array(4 * area);
    for (let i = 0; i < area; i++) for (let c = 0; c < 3; c++) texels[4 * i + c] = planes[c * area + i];
    const made = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, made);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA16UI, width, height, 0, gl.RGBA_INTEGER, gl.UNSIGNED_SHORT, texels);
    filters(gl, gl.TEXTURE_2D, gl.NEAREST);
    return made;
  }
}

// Lines of the gain and what belongs to them, as five layers of RGBA.
function linesOf(arrays, side) {
  const area = side * side;
  const plane = (all, c) => all.subarray(c * area, (c + 1) * area);
  const lines = [0, 1, 2].map((c) => interleaved(arrays.albedoLines.subarray(3 * c * area), plane(arrays.albedoLines, 9 + c), side));
  const bias = arrays.albedoLines.subarray(12 * area);
  const strands = new Float32Array(3 * area);
  strands.set(plane(arrays.hair, 1));
  return [...lines, interleaved(bias, plane(arrays.hair, 0), side), interleaved(strands, plane(arrays.hair, 1), side)];
}

// Planes of three channels and one of alpha as RGBA, times a gain.
function interleaved(planes, alpha, side, gain = 1) {
  const area = side * side;
  const texels = new Float32Array(4 * area);
  for (let i = 0; i < area; i++) {
    for (let c = 0; c < 3; c++) texels[4 * i + c] = gain * planes[c * area + i];
    texels[4 * i + 3] = alpha ? alpha[i] : 1;
  }
  return texels;
}

function* layersOf(planes, count, side, gain) {
  for (let i = 0; i < count; i++) yield interleaved(planes.subarray(3 * i * side * side), null, side, gain);
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

function filters(gl, kind, filter) {
  gl.texParameteri(kind, gl.TEXTURE_MIN_FILTER, filter);
  gl.texParameteri(kind, gl.TEXTURE_MAG_FILTER, filter);
  gl.texParameteri(kind, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
  gl.texParameteri(kind, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
}
