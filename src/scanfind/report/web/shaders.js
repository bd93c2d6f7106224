// What runs on the graphics card. Everything is drawn into a picture with depth, which is then shaded where depth steps.

const CUT = `
uniform vec3 cutLow, cutHigh;
bool outside(vec3 p) { return any(lessThan(p, cutLow)) || any(greaterThan(p, cutHigh)); }`;

const POINTS_VERTEX = `#version 300 es
uniform mat4 clipFromScene;
uniform vec3 low, size;
uniform float width, least; // of a point: at one metre, and at least, pixels
in vec3 position;
in float value;
out vec3 at;
flat out float told;
void main() {
  at = low + position * size;
  told = value;
  gl_Position = clipFromScene * vec4(at, 1.0);
  gl_PointSize = clamp(width / gl_Position.w, least, 4.0 * least);
}`;

// how: 0 deviation, 1 within the limit, 2 one colour, 3 how light.
const POINTS_FRAGMENT = `#version 300 es
precision highp float;
uniform int how;
uniform float full, limit, fade;
uniform vec3 flatColour, faded, within, stops[5];
in vec3 at;
flat in float told;
out vec4 colour;
${CUT}
vec3 ramp(float t) {
  float s = (clamp(t, -1.0, 1.0) + 1.0) * 2.0;
  int k = int(min(s, 3.999));
  return mix(stops[k], stops[k + 1], s - float(k));
}
void main() {
  vec2 aside = gl_PointCoord - 0.5;
  if (outside(at) || dot(aside, aside) > 0.26) discard;
  vec3 c = flatColour;
  if (how == 0) c = ramp(told * full / limit);
  if (how == 1) c = abs(told * full) <= limit ? within : (told > 0.0 ? stops[4] : stops[0]);
  if (how == 3) c = mix(flatColour * 0.75, min(flatColour * 1.3, 1.0), told);
  colour = vec4(mix(c, faded, fade), 1.0);
}`;

const SHAPE_VERTEX = `#version 300 es
uniform mat4 clipFromScene, sceneFromShape;
in vec3 position;
out vec3 at;
void main() {
  vec4 p = sceneFromShape * vec4(position, 1.0);
  at = p.xyz;
  gl_Position = clipFromScene * p;
  gl_PointSize = 2.0;
}`;

const SHAPE_FRAGMENT = `#version 300 es
precision highp float;
uniform vec3 flatColour, towards;
uniform float opacity;
uniform bool faces;
in vec3 at;
out vec4 colour;
${CUT}
void main() {
  if (outside(at)) discard;
  float light = 1.0;
  if (faces) light = 0.6 + 0.4 * abs(dot(normalize(cross(dFdx(at), dFdy(at))), towards));
  colour = vec4(flatColour * light, opacity);
}`;

// Which item is at a pixel, and how deep: both whole numbers, which every card can draw into.
const PICK_FRAGMENT = `#version 300 es
precision highp float;
uniform uint item;
in vec3 at;
out uvec4 told;
${CUT}
void main() {
  if (outside(at)) discard;
  told = uvec4(item, floatBitsToUint(gl_FragCoord.z), 0u, 1u);
}`;

const SCREEN_VERTEX = `#version 300 es
void main() {
  vec2 p = vec2(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0);
  gl_Position = vec4(p, 0.0, 1.0);
}`;

// Eye-dome lighting (Boucheny 2009): a pixel is darker the farther its neighbours stand before it.
const SCREEN_FRAGMENT = `#version 300 es
precision highp float;
uniform sampler2D picture, depths;
uniform float near, far;
out vec4 colour;
float away(ivec2 p) {
  p = clamp(p, ivec2(0), textureSize(depths, 0) - 1);
  float z = texelFetch(depths, p, 0).r * 2.0 - 1.0;
  return log2(2.0 * near * far / (far + near - z * (far - near)));
}
void main() {
  ivec2 p = ivec2(gl_FragCoord.xy);
  float here = away(p), sum = 0.0;
  for (int k = 0; k < 8; k++) {
    float angle = 0.785398 * float(k);
    sum += clamp(here - away(p + ivec2(round(1.6 * vec2(cos(angle), sin(angle))))), 0.0, 0.2);
  }
  colour = vec4(texelFetch(picture, p, 0).rgb * exp(-0.6 * sum), 1.0);
}`;
