// A pane: a canvas with shapes, a camera, and what the pointer does. All panes of a page share one WebGL renderer.
import { AmbientLight, DirectionalLight, HemisphereLight, PerspectiveCamera, Raycaster, Scene, Vector2, Vector3, WebGLRenderer } from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import { Layer } from "./layer.js";

const STEP = Math.PI / 18;           // by which an arrow key turns
const FULL = 0.97;                   // of half the picture, that bodies reach at most when they are looked at from a side
const SAMPLED = 5000;                // points by which that is measured

let renderer = null;
const waiting = new Set();

export function hasWebGL() {
  try {
    renderer ??= new WebGLRenderer({ antialias: true, alpha: true, preserveDrawingBuffer: false });
    return true;
  } catch {
    return false;
  }
}

function drawSoon(pane) {
  if (!waiting.size) requestAnimationFrame(drawAll);
  waiting.add(pane);
}

function drawAll() {
  const panes = [...waiting];
  waiting.clear();
  for (const pane of panes) pane.draw();
}

export class Pane {
  constructor(element, { camera, label, origin }) {
    this.element = element;
    this.origin = new Vector3().fromArray(origin);      // all places are relative to it
    this.layers = [];
    this.scene = new Scene();
    this.canvas = document.createElement("canvas");
    this.canvas.className = "sk-canvas";
    this.canvas.tabIndex = 0;
    this.canvas.setAttribute("role", "img");
    this.canvas.setAttribute("aria-label", label || "body, drag to turn");
    this.context = this.canvas.getContext("2d");
    element.append(this.canvas);
    this.camera = new PerspectiveCamera();
    this.camera.up.fromArray(camera.up);                // before the controls, which read it once
    this.controls = new OrbitControls(this.camera, this.canvas);
    this.controls.zoomToCursor = true;
    this.home = camera;
    this.lights();
    this.reset();
    this.controls.addEventListener("change", () => { this.redraw(); this.onTurn?.(this); if (this.held) this.onHand?.(); });
    this.controls.addEventListener("start", () => { this.held = true; });
    this.controls.addEventListener("end", () => { this.held = false; });
    this.canvas.addEventListener("wheel", (event) => {  // a page that scrolls goes on doing so until the body was touched
      if (!this.canvas.matches(":focus") && document.documentElement.scrollHeight > innerHeight + 1) event.stopImmediatePropagation();
    }, true);
    this.canvas.addEventListener("pointerdown", () => this.canvas.focus({ preventScroll: true }));
    this.canvas.addEventListener("keydown", (event) => this.turnBy(event));
    this.overlays = [];                                 // functions (context, pane) that draw over the picture
    new ResizeObserver(() => this.resize()).observe(this.canvas);
  }

  lights() {
    const key = new DirectionalLight(0xffffff, 1.9), fill = new DirectionalLight(0xffffff, 0.6);
    key.position.set(-0.5, 0.7, 1);
    fill.position.set(1, 0.1, 0.4);
    this.camera.add(key, key.target, fill, fill.target, new AmbientLight(0xffffff, 0.35));
    const sky = new HemisphereLight(0xffffff, 0x8f8880, 0.75);
    sky.position.copy(this.camera.up);
    this.scene.add(this.camera, sky);
  }

  // Back to the view that the scene came with, or to another side: degrees about the vertical, and upwards.
  reset(azimuth = 0, elevation = null) {
    const up = this.camera.up.clone().normalize();
    const back = new Vector3().fromArray(this.home.back).applyAxisAngle(up, azimuth * Math.PI / 180);
    if (elevation !== null) {
      const flat = back.clone().addScaledVector(up, -back.dot(up)).normalize();
      back.copy(flat.multiplyScalar(Math.cos(elevation * Math.PI / 180))).addScaledVector(up, Math.sin(elevation * Math.PI / 180));
    }
    this.controls.target.fromArray(this.home.target);
    this.camera.zoom = 1;
    this.camera.position.copy(this.controls.target).addScaledVector(back, this.home.distance);
    this.lens();
    this.controls.update();
    this.fit();
  }

  // A step back where the body is wider from this side, so that nothing is cut off.
  fit() {
    const far = this.reach() / FULL;
    if (far > 1) {
      this.camera.position.sub(this.controls.target).multiplyScalar(far).add(this.controls.target);
      this.controls.update();
    }
    this.redraw();
  }

  // How far what is shown reaches from the middle of the picture; 1 is its border.
  reach() {
    this.camera.updateMatrixWorld();
    let most = 0;
    const point = new Vector3();
    for (const { count, positions, hidden } of this.layers.filter((layer) => layer.object.visible)) {
      for (let i = 0, step = Math.ceil(count / SAMPLED); i < count; i += step) {
        if (hidden.has(i)) continue;
        point.fromArray(positions, 3 * i).project(this.camera);
        for (const far of [Math.abs(point.x), Math.abs(point.y)]) if (far > most && point.z < 1) most = far;
      }
    }
    return most;
  }

  // Arrow keys turn the body, as a drag does.
  turnBy(event) {
    const [aside, upward] = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key] ?? [0, 0];
    if (!(aside || upward) || !this.controls.enabled) return;
    event.preventDefault();
    this.onHand?.();
    const up = this.camera.up.clone().normalize(), back = this.camera.position.clone().sub(this.controls.target);
    const angle = back.angleTo(up) - upward * STEP;
    if (upward && angle > STEP && angle < Math.PI - STEP) back.applyAxisAngle(up.clone().cross(back).normalize(), -upward * STEP);
    this.camera.position.copy(this.controls.target).add(back.applyAxisAngle(up, aside * STEP));
    this.controls.update();
  }

  lens() {
    const aspect = Math.max(this.canvas.clientWidth, 1) / Math.max(this.canvas.clientHeight, 1);
    const { width, height, distance } = this.home;
    this.camera.aspect = aspect;
    this.camera.fov = 2 * Math.atan(Math.max(height, width / aspect) / 2 / distance) * 180 / Math.PI;
    this.camera.near = distance / 50;
    this.camera.far = distance * 50;
    this.camera.updateProjectionMatrix();
  }

  resize() {
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const width = Math.round(this.canvas.clientWidth * ratio), height = Math.round(this.canvas.clientHeight * ratio);
    if (!width || !height) return;
    this.canvas.width = width;
    this.canvas.height = height;
    this.lens();
    this.draw();                                        // at once: a canvas of a new size is empty
  }

  add(layer) {
    this.layers.push(layer);
    this.scene.add(layer.object);
    this.redraw();
    return layer;
  }

  remove(layer) {
    this.layers = this.layers.filter((other) => other !== layer);
    this.scene.remove(layer.object);
    layer.dispose();
    this.redraw();
  }

  redraw() { drawSoon(this); }

  // Points with names that a program shows, in the colour given; they take the place of those of the same group.
  setDots(group, points, labels, color) {
    const old = this.layers.find((layer) => layer.group === group);
    if (old) this.remove(old);
    if (!points.length) return;
    const steps = Float32Array.from(points.flat(), (value, i) => value - this.origin.getComponent(i % 3));
    const layer = new Layer({ kind: "dots", name: "", labels, radius: 0.0065 * Math.max(this.home.height, this.home.width), on_top: false, faint: true, hidden: [],
      positions: { column: 0, low: [0, 0, 0], step: 1 }, shades: [{ name: "", palette: color.slice(1) }] }, [steps]);
    layer.group = group;
    this.add(layer);
  }

  view() { return { position: this.camera.position.clone(), target: this.controls.target.clone(), zoom: this.camera.zoom, home: this.home }; }

  restore({ position, target, zoom, home }) {
    const grown = this.home.distance / home.distance;
    if (Math.abs(Math.log(grown)) > 0.2 || home.back.some((x, i) => Math.abs(x - this.home.back[i]) > 0.3)) return;   // another kind of thing
    this.camera.position.copy(position);
    this.controls.target.copy(target);
    this.camera.zoom = zoom;
    this.controls.update();
    this.redraw();
  }

  draw() {
    const { width, height } = this.canvas;
    if (!width || !height || !hasWebGL()) return;
    const size = renderer.getSize(new Vector2());
    if (size.x < width || size.y < height) renderer.setSize(Math.max(size.x, width), Math.max(size.y, height), false);
    const tall = renderer.getSize(new Vector2()).y;
    for (const layer of this.layers) {
      for (const material of [layer.object.material, layer.object.cloud?.material, layer.object.ghost?.material]) {
        if (material?.uniforms?.pixels) material.uniforms.pixels.value = height;
      }
    }
    renderer.setViewport(0, 0, width, height);
    renderer.setScissor(0, 0, width, height);
    renderer.setScissorTest(true);
    renderer.render(this.scene, this.camera);
    this.context.fillStyle = getComputedStyle(this.canvas).backgroundColor;
    this.context.fillRect(0, 0, width, height);
    this.context.drawImage(renderer.domElement, 0, tall - height, width, height, 0, 0, width, height);
    const taken = this.told = [];                       // by labels: those drawn last in the list come first
    if (this.names !== false) for (const layer of [...this.layers].reverse()) drawLabels(this, layer, taken);
    for (const overlay of this.overlays) overlay(this.context, this);
    this.drawn = (this.drawn ?? 0) + 1;
  }

  // The ray of a pointer event: {raycaster, x, y}; x and y in pixels of the canvas.
  ray(event) {
    const box = this.canvas.getBoundingClientRect();
    const x = event.clientX - box.left, y = event.clientY - box.top;
    const raycaster = new Raycaster();
    this.camera.updateMatrixWorld();
    raycaster.setFromCamera(new Vector2(2 * x / box.width - 1, 1 - 2 * y / box.height), this.camera);
    return { raycaster, x, y };
  }

  // Whether a surface stands between the camera and a point.
  covers(point) {
    const way = point.clone().sub(this.camera.position), far = way.length();
    const raycaster = new Raycaster(this.camera.position, way.normalize(), 0, far - 0.01);
    return this.layers.some((layer) => layer.described.opacity === 1 && layer.hit(raycaster));
  }

  hit(event) {
    const { raycaster } = this.ray(event);
    const hits = this.layers.map((layer) => layer.hit(raycaster)).filter(Boolean);
    return hits.sort((a, b) => a.distance - b.distance)[0] ?? null;
  }

  // Where a point is in the picture, in pixels of the page; null behind the camera.
  project(point) {
    const p = point.clone().project(this.camera);
    if (p.z > 1) return null;
    return { x: (p.x + 1) / 2 * this.canvas.clientWidth, y: (1 - p.y) / 2 * this.canvas.clientHeight };
  }

  follow(other) {                                       // the same turn and zoom as another pane, about the own middle
    const shift = other.controls.target.clone().sub(new Vector3().fromArray(other.home.target));
    this.controls.target.fromArray(this.home.target).add(shift);
    const away = other.camera.position.clone().sub(other.controls.target);
    this.camera.position.copy(this.controls.target).addScaledVector(away, this.home.distance / other.home.distance);
    this.camera.lookAt(this.controls.target);
    this.redraw();
  }
}

function drawLabels(pane, layer, taken) {
  if (!layer.labels.length || !layer.object.visible) return;
  const { context } = pane, scale = pane.canvas.width / Math.max(pane.canvas.clientWidth, 1);
  context.font = `${12 * scale}px system-ui, sans-serif`;
  context.textBaseline = "middle";
  context.lineWidth = 3 * scale;
  const style = getComputedStyle(pane.canvas);
  context.strokeStyle = style.backgroundColor;
  context.fillStyle = style.color;
  layer.labels.forEach((text, i) => {
    if (!text || layer.hidden.has(i)) return;
    const point = new Vector3().fromArray(layer.positions, 3 * i), at = pane.project(point);
    if (!at || at.x < 0 || at.y < 0 || at.x > pane.canvas.clientWidth || at.y > pane.canvas.clientHeight) return;
    if (!layer.described.on_top && pane.covers(point)) return;
    const wide = context.measureText(text).width, high = 7 * scale, right = (at.x + 8) * scale, y = at.y * scale;
    const left = (at.x - 8) * scale - wide, x = right + wide <= pane.canvas.width ? right : Math.max(left, 0);
    if (taken.some((box) => x < box.right && x + wide > box.left && y - high < box.bottom && y + high > box.top)) return;
    taken.push({ text, left: x, right: x + wide, top: y - high, bottom: y + high });
    context.strokeText(text, x, y);
    context.fillText(text, x, y);
  });
}
