// The two shader programs: tool parts (instanced) and bone surface (blocks).

/** Headlight that moves with the camera, and skylight. */
const LIGHT = `
vec3 shade(vec3 colour, vec3 normal, vec3 toEye, float gloss) {
  vec3 key = normalize(toEye + vec3(0.25, -0.2, 0.55));
  float sky = 0.5 + 0.5 * normal.z;
  float lambert = max(dot(normal, key), 0.0);
  float shine = pow(max(dot(normal, normalize(key + toEye)), 0.0), 40.0) * gloss;
  return colour * (0.28 + 0.17 * sky + 0.62 * lambert) + shine;
}`;

export const PART_VERTEX = `#version 300 es
layout(location = 0) in vec3 a_position;
layout(location = 1) in vec3 a_normal;
layout(location = 2) in vec3 i_position;
layout(location = 3) in vec4 i_rotation;
layout(location = 4) in vec3 i_scale;
layout(location = 5) in vec4 i_colour;
uniform mat4 u_clipFromWorld;
out vec3 v_world;
out vec3 v_normal;
out vec4 v_colour;
vec3 turn(vec4 q, vec3 v) {
  vec3 t = 2.0 * cross(q.xyz, v);
  return v + q.w * t + cross(q.xyz, t);
}
void main() {
  v_world = i_position + turn(i_rotation, a_position * i_scale);
  v_normal = turn(i_rotation, a_normal / i_scale);
  v_colour = i_colour;
  gl_Position = u_clipFromWorld * vec4(v_world, 1.0);
}`;

export const PART_FRAGMENT = `#version 300 es
precision highp float;
in vec3 v_world;
in vec3 v_normal;
in vec4 v_colour;
uniform vec3 u_eye;
uniform vec3 u_toolBase;
uniform vec3 u_tip;
uniform float u_fade;
out vec4 colour;
${LIGHT}
/** 0 to 1: how close a point in front of the tool is to the line of sight, within u_fade metres. */
float beforeTool(vec3 point) {
  vec3 sight = normalize(point - u_eye);
  float most = 0.0;
  for (int i = 0; i <= 4; i++) {
    vec3 away = mix(u_toolBase, u_tip, float(i) / 4.0) - u_eye;
    float ahead = dot(away, sight);
    float beside = length(away - ahead * sight);
    if (ahead > distance(point, u_eye)) most = max(most, 1.0 - smoothstep(0.6 * u_fade, u_fade, beside));
  }
  return most;
}
void main() {
  vec3 toEye = normalize(u_eye - v_world);
  vec3 normal = normalize(v_normal);
  float alpha = v_colour.a;
  if (u_fade > 0.0) alpha *= 1.0 - 0.9 * beforeTool(v_world);
  colour = vec4(shade(v_colour.rgb, normal, toEye, 0.35) * alpha, alpha);
}`;

export const SURFACE_VERTEX = `#version 300 es
layout(location = 0) in vec3 a_position;
layout(location = 1) in vec3 a_normal;
uniform mat4 u_clipFromWorld;
uniform vec3 u_origin;
uniform float u_scale;
out vec3 v_world;
out vec3 v_normal;
void main() {
  v_world = u_origin + u_scale * a_position;
  v_normal = a_normal;
  gl_Position = u_clipFromWorld * vec4(v_world, 1.0);
}`;

/** `u_side`: 0 everything, +1 behind the cut, -1 in front of it. `u_glass`: 1 translucent. */
export const SURFACE_FRAGMENT = `#version 300 es
precision highp float;
in vec3 v_world;
in vec3 v_normal;
uniform vec3 u_eye;
uniform vec4 u_plane;
uniform float u_side;
uniform float u_glass;
uniform vec3 u_bone;
uniform vec3 u_inside;
out vec4 colour;
${LIGHT}
void main() {
  if (u_side * (dot(u_plane.xyz, v_world) + u_plane.w) > 0.0) discard;
  vec3 toEye = normalize(u_eye - v_world);
  vec3 normal = normalize(v_normal);
  float facing = dot(normal, toEye);
  if (u_glass > 0.5) {
    float rim = pow(1.0 - abs(facing), 2.0);
    float alpha = 0.05 + 0.4 * rim;
    colour = vec4(shade(u_bone, facing < 0.0 ? -normal : normal, toEye, 0.1) * alpha, alpha);
  } else if (facing < 0.0) {
    colour = vec4(u_inside, 1.0);
  } else {
    colour = vec4(shade(u_bone, normal, toEye, 0.06), 1.0);
  }
}`;
