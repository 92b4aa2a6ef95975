"use strict";
/* Bodies of the scene in WebGL: quadcopters, the spheres that must not meet, and what an agent believes as ghosts. */
import * as THREE from "./three.module.min.js";

const ROTORS = [[1, 1], [1, -1], [-1, 1], [-1, -1]];

/* One geometry of several. */
function merged(parts) {
  const position = [], normal = [], index = [];
  for (const part of parts) {
    const first = position.length / 3;
    position.push(...part.attributes.position.array); normal.push(...part.attributes.normal.array);
    index.push(...Array.from(part.index.array, value => value + first));
    part.dispose();
  }
  const whole = new THREE.BufferGeometry();
  whole.setAttribute("position", new THREE.Float32BufferAttribute(position, 3));
  whole.setAttribute("normal", new THREE.Float32BufferAttribute(normal, 3));
  whole.setIndex(index);
  return whole;
}

/* A quadcopter of span 2 (1): two arms, four rotors, a hull. */
function quadcopter() {
  const arms = [Math.PI / 4, -Math.PI / 4].map(angle => new THREE.BoxGeometry(1.9, 0.13, 0.1).rotateZ(angle));
  const rotors = ROTORS.map(([x, y]) => new THREE.CylinderGeometry(0.4, 0.4, 0.05, 12).rotateX(Math.PI / 2).translate(0.66 * x, 0.66 * y, 0.14));
  return merged([...arms, ...rotors, new THREE.BoxGeometry(0.55, 0.4, 0.26)]);
}

const SOFTWARE_AGENTS = 30; // where the processor draws in place of a graphics card, discs are faster for more

/* Whether the processor has to draw what a graphics card should. */
function drawnBySoftware() {
  const gl = document.createElement("canvas").getContext("webgl2");
  if (!gl) return true;
  const known = gl.getExtension("WEBGL_debug_renderer_info"), name = known ? gl.getParameter(known.UNMASKED_RENDERER_WEBGL) : "";
  gl.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|software|basic render/i.test(name);
}

export class Bodies {
  /* A layer of a scene; null where WebGL is missing or too slow for so many agents: then the scene draws discs. */
  static make(scene) {
    const software = drawnBySoftware();
    if (software && scene.count > SOFTWARE_AGENTS) return null;
    try { return new Bodies(scene, software); } catch { return null; }
  }

  constructor(scene, software) {
    this.scene = scene;
    this.canvas = el("canvas", {"aria-hidden": "true", class: "bodies"});
    this.renderer = new THREE.WebGLRenderer({canvas: this.canvas, alpha: true, antialias: !software, powerPreference: "low-power"});
    this.world = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(50, 1, 0.05, 1000);
    const sun = new THREE.DirectionalLight(0xffffff, 1.9);
    sun.position.set(1.5, -1, 3);
    this.world.add(new THREE.AmbientLight(0xffffff, 1.5), sun);
    const n = scene.count, sphere = new THREE.SphereGeometry(1, 18, 12);
    const glassy = opacity => new THREE.MeshLambertMaterial({transparent: true, opacity, depthWrite: false});
    this.craft = new THREE.InstancedMesh(quadcopter(), new THREE.MeshLambertMaterial(), n);
    this.spheres = new THREE.InstancedMesh(sphere, glassy(0.2), n);
    this.ghosts = new THREE.InstancedMesh(sphere, glassy(0.34), n);
    for (const mesh of [this.craft, this.spheres, this.ghosts]) { mesh.frustumCulled = false; this.world.add(mesh); }
    this.colors = "";
    this.lost = false;
    this.canvas.addEventListener("webglcontextlost", event => { event.preventDefault(); this.lost = true; });
    this.canvas.addEventListener("webglcontextrestored", () => { this.lost = false; });
  }

  resize(width, height) {
    if (this.size !== `${width} ${height} ${sharpness.ratio}`) { // to set it anew would clear it
      this.size = `${width} ${height} ${sharpness.ratio}`;
      this.renderer.setPixelRatio(sharpness.ratio);
      this.renderer.setSize(width, height, false);
    }
    this.camera.aspect = width / height;
  }

  /* radius: m, of an agent as the scene draws it; ghosts: as the run gives them, or null. */
  draw(radius, ghosts) {
    if (this.lost) return;
    const {scene, camera} = this, {eye, right, up, forward, focal} = scene.eye, n = scene.count, now = scene.now;
    camera.fov = 2 * Math.atan(scene.height / 2 / focal) * 180 / Math.PI;
    camera.position.set(...eye);
    camera.quaternion.setFromRotationMatrix(new THREE.Matrix4().makeBasis(
      new THREE.Vector3(...right), new THREE.Vector3(...up), new THREE.Vector3(...forward.map(value => -value))));
    camera.updateProjectionMatrix();
    this.paint();
    const matrix = new THREE.Matrix4(), safe = (scene.run.collision_m || 0.2) / 2;
    const place = (mesh, agent, at, size) => mesh.setMatrixAt(agent, matrix.makeScale(size, size, size).setPosition(at[agent], at[agent + n], at[agent + 2 * n]));
    for (let agent = 0; agent < n; agent++) {
      place(this.craft, agent, now, radius);
      place(this.spheres, agent, now, safe);
      if (ghosts && ghosts.known(agent)) place(this.ghosts, agent, ghosts.place, radius * 0.9); else place(this.ghosts, agent, now, 0);
    }
    this.ghosts.visible = Boolean(ghosts);
    for (const mesh of [this.craft, this.spheres, this.ghosts]) mesh.instanceMatrix.needsUpdate = true;
    this.renderer.render(this.world, camera);
  }

  /* Colours, where they have changed: who is lost is grey. */
  paint() {
    const wanted = Array.from({length: this.scene.count}, (_, agent) => this.scene.color(agent)), key = wanted.join();
    if (key === this.colors) return;
    this.colors = key;
    for (const mesh of [this.craft, this.spheres, this.ghosts]) {
      wanted.forEach((color, agent) => mesh.setColorAt(agent, new THREE.Color(color)));
      mesh.instanceColor.needsUpdate = true;
    }
  }
}
