/**
 * How points become a picture: each in the colour of its height or its own, and then an eye-dome pass over their depths
 * (Boucheny, "Visualisation scientifique de grands volumes de données", 2009), which shades without any normals.
 */

import {
  AlwaysDepth,
  Color,
  DepthTexture,
  FloatType,
  GLSL3,
  Mesh,
  NearestFilter,
  OrthographicCamera,
  PlaneGeometry,
  RawShaderMaterial,
  Scene as Group,
  UnsignedByteType,
  Vector2,
  Vector3,
  Vector4,
  WebGLRenderTarget,
} from "three";
import type { PerspectiveCamera, WebGLRenderer } from "three";

import type { Theme } from "./types.ts";

/** Pixels of a point, at most. */
export const LARGEST = 40;

/** What all points of a scene share: the materials of every cloud and tile point to these. */
export interface PointUniforms {
  [name: string]: { value: unknown };
  /** Low and high end of the section, metres. */
  section: { value: Vector2 };
  /** Heights that the ramp of colours goes between, metres. */
  ramp: { value: Vector2 };
  low: { value: Color };
  middle: { value: Color };
  high: { value: Color };
  back: { value: Color };
  /** 1: what is outside of the chosen boxes is dim, and what would hide them is left out. */
  dim: { value: number };
  chosen: { value: [Vector3, Vector3, Vector3, Vector3] };
  /** Pixels of the picture that a metre takes at a distance of a metre. */
  scale: { value: number };
}

const POINT_VERTEX = /* glsl */ `
precision highp float;
uniform mat4 modelMatrix, viewMatrix, projectionMatrix;
uniform vec3 cameraPosition;
uniform vec2 section, ramp;
uniform vec3 low, middle, high, back;
uniform vec3 chosen[4];
uniform float dim, scale, spacing, share, cap;
uniform int parts;
in vec3 position;
#ifdef TINTED
in vec4 tint;
#endif
out vec3 colour;

bool inside(vec3 p, vec3 least, vec3 most) { return all(greaterThan(p, least)) && all(lessThan(p, most)); }

/* Tell whether a point stands before a chosen box, in the cone from the camera to it: it would hide what is shown. */
bool hides(vec3 p, vec3 least, vec3 most) {
  vec3 centre = 0.5 * (least + most), towards = centre - cameraPosition;
  float radius = 0.55 * length(most - least), far = length(towards);
  float along = dot(p - cameraPosition, towards / far);
  return along < far - radius && length(p - cameraPosition - along * towards / far) < radius * along / far;
}

void main() {
  vec4 world = modelMatrix * vec4(position, 1.0);
  int part = 1;
#ifdef TINTED
  if (tint.a > 0.55 && tint.a < 0.75) part = 2;
#endif
  if (world.z < section.x || world.z > section.y || (parts & part) == 0) {
    gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
    return;
  }
  bool other = dim > 0.0 && !inside(world.xyz, chosen[0], chosen[1]) && !inside(world.xyz, chosen[2], chosen[3]);
  if (other && (hides(world.xyz, chosen[0], chosen[1]) || hides(world.xyz, chosen[2], chosen[3]))) {
    gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
    return;
  }
  float height = clamp((world.z - ramp.x) / max(ramp.y - ramp.x, 0.1), 0.0, 1.0);
  colour = height < 0.5 ? mix(low, middle, 2.0 * height) : mix(middle, high, 2.0 * height - 1.0);
  float size = 1.55, nearer = 0.0; /* painted points win where the map has grey ones in the same place */
#ifdef TINTED
  if (tint.a > 0.75) colour = tint.rgb;
  else if (tint.a > 0.4) { colour = tint.rgb; size = 1.9; nearer = 0.002; }
  else if (tint.a > 0.1) colour = mix(colour, back, 0.5);
#endif
  if (other) colour = mix(colour, back, 0.45 * dim);
  vec4 eye = viewMatrix * world;
  eye.xyz *= 1.0 - nearer;
  gl_Position = projectionMatrix * eye;
  gl_PointSize = clamp(size * spacing * scale * inversesqrt(share) / -eye.z, 1.5, cap);
}`;

const POINT_FRAGMENT = /* glsl */ `
precision mediump float;
in vec3 colour;
out vec4 painted;
void main() {
  vec2 off = gl_PointCoord - 0.5;
  if (dot(off, off) > 0.27) discard;
  painted = vec4(colour, 1.0);
}`;

const PASS_VERTEX = /* glsl */ `
in vec3 position;
void main() { gl_Position = vec4(position.xy, 0.0, 1.0); }`;

const PASS_FRAGMENT = /* glsl */ `
precision highp float;
uniform sampler2D colours;
uniform highp sampler2D depths;
uniform vec2 nearness;
uniform ivec4 area;
uniform vec3 backLow, backHigh;
uniform float strength, grain;
uniform int radius;
out vec4 painted;

const ivec2 AROUND[8] = ivec2[8](
  ivec2(1, 0), ivec2(-1, 0), ivec2(0, 1), ivec2(0, -1), ivec2(1, 1), ivec2(-1, -1), ivec2(1, -1), ivec2(-1, 1));

float depthAt(ivec2 pixel) { return texelFetch(depths, clamp(pixel, area.xy, area.zw), 0).r; }

/* Return a neighbour in whose stead a pixel is painted that is a hole in a surface: most around it are not empty. */
ivec2 filled(ivec2 pixel) {
  ivec2 best = pixel;
  for (int reach = 1; reach <= 2; reach++) {
    int taken = 0;
    float nearest = 1.0;
    for (int i = 0; i < 8; i++) {
      if (i == 4 && taken == 0) return pixel;
      float depth = depthAt(pixel + reach * AROUND[i]);
      if (depth < 1.0) taken++;
      if (depth < nearest) { nearest = depth; best = pixel + reach * AROUND[i]; }
    }
    if (taken >= 5) return clamp(best, area.xy, area.zw);
  }
  return pixel;
}

/* One over a distance is linear in depth; steps are so small that the logarithm of their ratio is what it is above 1. */
void main() {
  ivec2 pixel = ivec2(gl_FragCoord.xy);
  float depth = texelFetch(depths, pixel, 0).r;
  if (depth == 1.0) { pixel = filled(pixel); depth = depthAt(pixel); }
  gl_FragDepth = depth;
  if (depth == 1.0) {
    painted = vec4(mix(backLow, backHigh, gl_FragCoord.y / float(area.w)), 1.0);
    return;
  }
  float here = nearness.x - nearness.y * depth;
  float even = 1.4427 * grain * here; // neighbours on one surface differ by that
  float sum = 0.0;
  for (int i = 0; i < 8; i++) {
    float next = nearness.x - nearness.y * depthAt(pixel + radius * AROUND[i]);
    sum += clamp(1.4427 * (next / here - 1.0) - even, 0.0, 0.1);
  }
  painted = vec4(texelFetch(colours, pixel, 0).rgb * exp(-strength * sum / 8.0), 1.0);
}`;

/** Colours of heights and of the ground behind, by theme: quiet ones, so that what changed stands out. */
const PALETTES: Readonly<Record<Theme, { low: string; middle: string; high: string; backLow: string; backHigh: string }>> = {
  light: { low: "#6f8295", middle: "#a9b6b5", high: "#dcd6c4", backLow: "#e6eaee", backHigh: "#f8fafb" },
  dark: { low: "#46586b", middle: "#7d8f95", high: "#bdb9a8", backLow: "#0e1217", backHigh: "#1a2028" },
};

/** Return the uniforms that all points share. */
export function pointUniforms(): PointUniforms {
  return {
    section: { value: new Vector2(-1e9, 1e9) },
    ramp: { value: new Vector2(0, 3) },
    low: { value: new Color() },
    middle: { value: new Color() },
    high: { value: new Color() },
    back: { value: new Color() },
    dim: { value: 0 },
    chosen: { value: [new Vector3(), new Vector3(), new Vector3(), new Vector3()] },
    scale: { value: 1 },
  };
}

/** Return a material for points `spacing` metres apart; `tinted`: they have the attribute `tint`. */
export function pointMaterial(shared: PointUniforms, spacing: number, tinted: boolean): RawShaderMaterial {
  return new RawShaderMaterial({
    glslVersion: GLSL3,
    vertexShader: POINT_VERTEX,
    fragmentShader: POINT_FRAGMENT,
    defines: tinted ? { TINTED: 1 } : {},
    uniforms: { ...shared, spacing: { value: spacing }, share: { value: 1 }, cap: { value: LARGEST }, parts: { value: 3 } },
  });
}

/** The eye-dome pass: takes points drawn into `target`, and paints them shaded, with their depth, onto the canvas. */
export class EyeDome {
  readonly target = new WebGLRenderTarget(1, 1, {
    type: UnsignedByteType,
    minFilter: NearestFilter,
    magFilter: NearestFilter,
    depthTexture: new DepthTexture(1, 1, FloatType),
  });
  readonly #material = new RawShaderMaterial({
    glslVersion: GLSL3,
    vertexShader: PASS_VERTEX,
    fragmentShader: PASS_FRAGMENT,
    depthFunc: AlwaysDepth, // it brings the depth of the points
    uniforms: {
      colours: { value: this.target.texture },
      depths: { value: this.target.depthTexture },
      nearness: { value: new Vector2() },
      area: { value: new Vector4() },
      backLow: { value: new Color() },
      backHigh: { value: new Color() },
      radius: { value: 1 },
      strength: { value: 16 },
      grain: { value: 0 },
    },
  });
  readonly #pass = new Group();
  readonly #camera = new OrthographicCamera();

  constructor() {
    const mesh = new Mesh(new PlaneGeometry(2, 2), this.#material);
    mesh.frustumCulled = false;
    this.#pass.add(mesh);
  }

  /** Paint the rectangle `area` (left, bottom, right, top; pixels) of the target onto the canvas. */
  paint(renderer: WebGLRenderer, camera: PerspectiveCamera, area: Vector4, pixelRatio: number): void {
    const { nearness, area: shown, radius } = this.#material.uniforms as Record<string, { value: never }>;
    (nearness as { value: Vector2 }).value.set(1 / camera.near, 1 / camera.near - 1 / camera.far);
    (shown as { value: Vector4 }).value.set(area.x, area.y, area.z - 1, area.w - 1);
    (radius as { value: number }).value = Math.max(1, Math.round(1.2 * pixelRatio));
    renderer.render(this.#pass, this.#camera);
  }

  /** Take note how far apart points are, metres: smaller steps are no edges. */
  set grain(metres: number) {
    (this.#material.uniforms["grain"] as { value: number }).value = metres;
  }

  /** Take the colours of a theme, here and for all points. */
  setTheme(theme: Theme, points: PointUniforms): void {
    const palette = PALETTES[theme];
    points.low.value.set(palette.low);
    points.middle.value.set(palette.middle);
    points.high.value.set(palette.high);
    points.back.value.set(palette.backLow);
    (this.#material.uniforms["backLow"] as { value: Color }).value.set(palette.backLow);
    (this.#material.uniforms["backHigh"] as { value: Color }).value.set(palette.backHigh);
  }

  dispose(): void {
    this.target.depthTexture?.dispose();
    this.target.dispose();
    this.#material.dispose();
  }
}
