// One shape on the screen: a mesh, dots or bones; its colours, its motion, its places.
import {
  BufferAttribute, BufferGeometry, Color, CylinderGeometry, DoubleSide, InstancedMesh, Matrix4, Mesh, MeshLambertMaterial,
  Points, Quaternion, ShaderMaterial, SRGBColorSpace, Vector3,
} from "three";
import { MeshBVH, acceleratedRaycast } from "three-mesh-bvh";

Mesh.prototype.raycast = acceleratedRaycast;

export const SURFACES = ["smooth", "flat", "wire", "points"];

// Display colours (0-255) as linear light, which shaders want.
const LIGHT = Float32Array.from({ length: 256 }, (_, i) => new Color().setRGB(i / 255, 0, 0, SRGBColorSpace).r);

export class Layer {
  constructor(described, columns) {
    Object.assign(this, { name: described.name, kind: described.kind, labels: described.labels ?? [], described, columns });
    this.positions = this.restPositions();
    this.count = this.positions.length / 3;
    this.hidden = new Set(described.hidden ?? []);
    this.shades = described.shades;
    this.geometry = new BufferGeometry();
    this.geometry.setAttribute("position", new BufferAttribute(this.positions, 3));
    this.colors = new Float32Array(3 * this.count);
    this.geometry.setAttribute("color", new BufferAttribute(this.colors, 3));
    this.object = { mesh: makeMesh, dots: makeDots, bones: makeBones }[this.kind](this);
    this.object.visible = described.visible ?? true;
    this.object.renderOrder = described.on_top ? 2 : described.opacity < 1 ? 1 : 0;
    if (described.motion) this.motion = new Motion(described.motion, columns);
    this.setShade(0);
    this.moved();
  }

  restPositions() {
    const { column, low, step } = this.described.positions;
    const steps = this.columns[column];
    const out = new Float32Array(steps.length);
    for (let i = 0; i < out.length; i++) out[i] = low[i % 3] + step * steps[i];
    return out;
  }

  setShade(index) {
    const shade = this.shades[Math.min(index, this.shades.length - 1)];
    this.shade = shade;
    const palette = shade.palette && Uint8Array.from(shade.palette.match(/../g), (hex) => parseInt(hex, 16));
    const places = shade.index === undefined ? null : this.columns[shade.index];
    const own = shade.colors === undefined ? null : this.columns[shade.colors];
    for (let i = 0; i < this.count; i++) {
      for (let k = 0; k < 3; k++) {
        this.colors[3 * i + k] = LIGHT[own ? own[3 * i + k] : palette[places ? 3 * places[i] + k : k]];
      }
    }
    this.geometry.attributes.color.needsUpdate = true;
    this.object.recolor?.();
  }

  // A shade that is computed while one looks: values of the vertices, NaN is grey.
  setValues(values, low, high, title, palette) {
    const index = this.columns.push(new Uint8Array(this.count)) - 1;
    for (let i = 0; i < this.count; i++) {
      const share = (values[i] - low) / (high - low);
      this.columns[index][i] = Number.isNaN(share) ? 255 : Math.round(254 * Math.min(1, Math.max(0, share)));
    }
    this.shades = [...this.shades.filter((shade) => shade.name !== title),
      { name: title, index, palette, legend: { title, low, high } }];
    this.setShade(this.shades.length - 1);
  }

  // The value shown at a vertex as text, for the tip beside the pointer.
  valueAt(vertex) {
    const { legend, index } = this.shade;
    if (!legend) return "";
    const place = this.columns[index][vertex];
    if (place === 255) return "no data";
    const value = told(legend.low + (legend.high - legend.low) * place / 254, legend);
    return place === 254 && legend.more ? `${value} or more` : value;
  }

  setSurface(kind) {
    if (this.kind !== "mesh") return;
    this.surface = kind;
    this.object.material.flatShading = kind === "flat";
    this.object.material.wireframe = kind === "wire";
    this.object.material.needsUpdate = true;
    this.object.material.visible = kind !== "points";
    this.object.cloud.visible = kind === "points";
  }

  setPositions(values) {
    this.positions.set(values);
    this.moved();
  }

  setFrame(frame) {
    if (!this.motion) return;
    this.motion.write(frame, this.positions);
    this.hidden = this.motion.hidden(frame);
    this.moved();
  }

  moved() {
    const { geometry } = this;
    geometry.attributes.position.needsUpdate = true;
    if (this.kind === "mesh") vertexNormals(geometry);
    geometry.boundsTree = null;
    geometry.computeBoundingSphere();
    this.object.moved?.();
  }

  // The nearest hit of a ray: {point, face, vertex, distance}, or null.
  hit(raycaster) {
    if (this.kind !== "mesh" || !this.object.visible || !this.positions.length) return null;
    this.geometry.boundsTree ??= new MeshBVH(this.geometry, { indirect: true });
    raycaster.firstHitOnly = true;
    const found = raycaster.intersectObject(this.object, false)[0];
    if (!found) return null;
    const corners = [found.face.a, found.face.b, found.face.c];
    const apart = corners.map((v) => found.point.distanceToSquared(new Vector3().fromArray(this.positions, 3 * v)));
    return { layer: this, point: found.point, face: found.faceIndex, distance: found.distance,
      vertex: corners[apart.indexOf(Math.min(...apart))] };
  }

  dispose() {
    this.geometry.dispose();
    this.object.material.dispose();
    this.object.tube?.dispose();
  }
}

// A value in the unit of its legend.
export function told(value, { unit }) {
  return unit === "%" ? `${(100 * value).toFixed(0)}%` : millimetres(value);
}

export function millimetres(metres) {
  const value = 1000 * metres;
  return `${Math.abs(value) >= 100 ? value.toFixed(0) : Number(value.toPrecision(3))} mm`;
}

// Frames as columns times coefficients, see scanprep/pictures/low_rank.py.
class Motion {
  constructor({ rate, frames, rank, basis, coefficients, scale, seen }, columns) {
    Object.assign(this, { rate, frames, rank, coefficients: new Int16Array(columns[coefficients].buffer) });
    this.seen = seen === undefined ? null : columns[seen];
    this.scale = scale;
    this.basis = basis === null ? null : Float32Array.from(columns[basis]);      // without: each point on its own
    this.count = basis === null ? rank : this.basis.length / rank;
  }

  write(frame, positions) {
    const { rank, basis } = this;
    const row = this.coefficients.subarray(3 * rank * frame, 3 * rank * (frame + 1));
    const c = Float32Array.from(row, (value, i) => value * this.scale[Math.floor(i / 3)]);
    if (!basis) { positions.set(c); return; }
    for (let n = 0, at = 0; n < this.count; n++) {
      let x = 0, y = 0, z = 0;
      for (let r = 0, k = 0; r < rank; r++, k += 3, at++) {
        const b = basis[at];
        x += b * c[k]; y += b * c[k + 1]; z += b * c[k + 2];
      }
      positions[3 * n] = x; positions[3 * n + 1] = y; positions[3 * n + 2] = z;
    }
  }

  hidden(frame) {
    const out = new Set();
    if (this.seen) for (let n = 0; n < this.count; n++) if (!this.seen[frame * this.count + n]) out.add(n);
    return out;
  }
}

function vertexNormals(geometry) {
  const x = geometry.attributes.position.array, faces = geometry.index.array;
  const out = geometry.attributes.normal.array.fill(0);
  for (let f = 0; f < faces.length; f += 3) {
    const a = 3 * faces[f], b = 3 * faces[f + 1], c = 3 * faces[f + 2];
    const ux = x[b] - x[a], uy = x[b + 1] - x[a + 1], uz = x[b + 2] - x[a + 2];
    const vx = x[c] - x[a], vy = x[c + 1] - x[a + 1], vz = x[c + 2] - x[a + 2];
    const nx = uy * vz - uz * vy, ny = uz * vx - ux * vz, nz = ux * vy - uy * vx;
    for (const v of [a, b, c]) { out[v] += nx; out[v + 1] += ny; out[v + 2] += nz; }
  }
  geometry.attributes.normal.needsUpdate = true;      // the shader makes them unit vectors
}

function makeMesh(layer) {
  const { geometry, described, columns } = layer;
  geometry.setAttribute("normal", new BufferAttribute(new Float32Array(layer.positions.length), 3));
  geometry.setIndex(new BufferAttribute(columns[described.faces], 1));
  const material = new MeshLambertMaterial({ vertexColors: true, side: DoubleSide, opacity: described.opacity,
    transparent: described.opacity < 1, depthWrite: described.opacity >= 1, flatShading: !described.smooth });
  material.onBeforeCompile = (shader) => {            // the inside of a surface is dark
    shader.fragmentShader = shader.fragmentShader.replace("#include <color_fragment>",
      "#include <color_fragment>\nif (!gl_FrontFacing) diffuseColor.rgb *= 0.45;");
  };
  const mesh = new Mesh(geometry, material);
  mesh.frustumCulled = false;
  mesh.cloud = new Points(geometry, dotMaterial(0.0022, false));
  mesh.cloud.visible = false;
  mesh.cloud.frustumCulled = false;
  mesh.add(mesh.cloud);
  return mesh;
}

function makeDots(layer) {
  const { radius, on_top: onTop, faint } = layer.described;
  const points = new Points(layer.geometry, dotMaterial(radius, onTop));
  points.frustumCulled = false;
  if (faint) {                                        // and through surfaces, but faintly
    points.ghost = new Points(layer.geometry, dotMaterial(radius, true, 0.3));
    points.ghost.frustumCulled = false;
    points.add(points.ghost);
  }
  points.moved = () => {                              // those that nothing is known of are far away
    for (const v of layer.hidden) layer.positions.fill(1e6, 3 * v, 3 * v + 3);
  };
  return points;
}

// Balls of a size in metres: squares that face the camera, shaded as balls.
function dotMaterial(radius, onTop, opacity = onTop ? 0.85 : 1) {
  return new ShaderMaterial({
    uniforms: { radius: { value: radius }, pixels: { value: 500 } },
    vertexColors: true, depthTest: !onTop, depthWrite: !onTop, transparent: onTop,
    vertexShader: `uniform float radius, pixels; varying vec3 shade;
      void main() {
        shade = color;
        vec4 eye = modelViewMatrix * vec4(position, 1.0);
        vec4 front = projectionMatrix * (eye + vec4(0.0, 0.0, radius, 0.0));    // half of a ball on a skin is in sight
        gl_Position = projectionMatrix * eye;
        gl_Position.z = front.z / front.w * gl_Position.w;
        gl_PointSize = max(2.0, radius * pixels * projectionMatrix[1][1] / gl_Position.w);
      }`,
    fragmentShader: `varying vec3 shade;
      void main() {
        vec2 p = 2.0 * gl_PointCoord - 1.0;
        float r = dot(p, p);
        if (r > 1.0) discard;
        vec3 normal = vec3(p.x, -p.y, sqrt(1.0 - r));
        float light = 0.45 + 0.65 * max(0.0, dot(normal, normalize(vec3(-0.4, 0.6, 0.8))));
        gl_FragColor = vec4(shade * light, ${opacity.toFixed(2)});
        #include <colorspace_fragment>
      }`,
  });
}

function makeBones(layer) {
  const { positions, described } = layer;
  const tube = new CylinderGeometry(described.radius, described.radius, 1, 12, 1);
  const material = new MeshLambertMaterial({ depthTest: !described.on_top });
  const bones = new InstancedMesh(tube, material, positions.length / 6);
  bones.frustumCulled = false;
  bones.tube = tube;
  bones.raycast = () => {};
  bones.recolor = () => {
    for (let i = 0; i < bones.count; i++) bones.setColorAt(i, new Color().fromArray(layer.colors, 6 * i));
    if (bones.instanceColor) bones.instanceColor.needsUpdate = true;
  };
  bones.moved = () => {
    const upward = new Vector3(0, 1, 0), turn = new Quaternion(), matrix = new Matrix4();
    for (let i = 0; i < bones.count; i++) {
      const start = new Vector3().fromArray(positions, 6 * i), end = new Vector3().fromArray(positions, 6 * i + 3);
      const along = end.clone().sub(start), length = Math.max(along.length(), 1e-6);
      turn.setFromUnitVectors(upward, along.divideScalar(length));
      bones.setMatrixAt(i, matrix.compose(start.add(end).multiplyScalar(0.5), turn, new Vector3(1, length, 1)));
    }
    bones.instanceMatrix.needsUpdate = true;
  };
  return bones;
}
