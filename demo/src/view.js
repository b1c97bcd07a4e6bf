// Draws a model with three.js, from its geoms.

import * as THREE from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";

// MuJoCo's mjtGeom
const PLANE = 0;
const SPHERE = 2;
const CAPSULE = 3;
const ELLIPSOID = 4;
const CYLINDER = 5;
const BOX = 6;
const MESH = 7;
const VISUAL = 2; // the group of what is to be seen
const DECK = /deck$/; // material of the board's top

/** The 3-D view of one physics. */
export class View {
  /**
   * @param {HTMLCanvasElement} canvas
   * @throws if the browser has no WebGL
   */
  constructor(canvas) {
    this.canvas = canvas;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true });
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.shadowMap.enabled = true;
    this.renderer.shadowMap.type = THREE.PCFShadowMap;
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(32, 1, 0.05, 60);
    this.camera.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.enableDamping = true;
    this.controls.enablePan = false;
    this.controls.maxPolarAngle = 1.65;
    this.dark = matchMedia("(prefers-color-scheme: dark)");
    this.dark.addEventListener("change", () => this.light());
    this.hemisphere = new THREE.HemisphereLight();
    this.key = new THREE.DirectionalLight(0xfff3e2);
    this.key.castShadow = true;
    this.key.shadow.mapSize.set(1024, 1024);
    this.key.shadow.radius = 5;
    this.key.shadow.bias = -0.0004;
    this.fill = new THREE.DirectionalLight(0xcfdcf0);
    this.scene.add(this.hemisphere, this.key, this.key.target, this.fill);
    this.shadow = new THREE.Mesh(new THREE.PlaneGeometry(1, 1), new THREE.ShadowMaterial({ opacity: 0.2 }));
    this.shadow.receiveShadow = true;
    this.scene.add(this.shadow);
    /** Bodies of the model, by id. @type {THREE.Group[]} */
    this.bodies = [];
    this.light();
  }

  /** Lights and background of the colour scheme. */
  light() {
    const paper = getComputedStyle(document.documentElement).getPropertyValue("--paper");
    const dark = this.dark.matches;
    this.scene.background = new THREE.Color(paper);
    this.hemisphere.color.set(dark ? 0xb8c4d6 : 0xffffff);
    this.hemisphere.groundColor.set(dark ? 0x2b2723 : 0xb9aa98);
    this.hemisphere.intensity = dark ? 1.1 : 1.7;
    this.key.intensity = dark ? 2.2 : 2.4;
    this.fill.intensity = dark ? 0.5 : 0.6;
    /** @type {THREE.ShadowMaterial} */ (this.shadow.material).opacity = dark ? 0.5 : 0.18;
  }

  /** Takes another model. @param {import("./physics.js").Physics} physics */
  show(physics) {
    for (const body of this.bodies) {
      this.scene.remove(body);
      body.traverse((part) => {
        if (part instanceof THREE.Mesh) {
          part.geometry.dispose();
          part.material.dispose();
        }
      });
    }
    const { model } = physics;
    this.bodies = Array.from({ length: model.nbody }, () => new THREE.Group());
    this.scene.add(...this.bodies);
    let floor = -0.4;
    for (let k = 0; k < model.ngeom; k++) {
      if (model.geom_type[k] === PLANE) {
        floor = model.geom_pos[3 * k + 2];
      } else if (model.geom_group[k] === VISUAL) {
        this.bodies[model.geom_bodyid[k]].add(drawGeom(physics.mujoco, model, k));
      }
    }
    this.shadow.position.z = floor;
    this.update(physics);
    const box = new THREE.Box3();
    this.bodies.forEach((body) => box.expandByObject(body));
    this.frame(box);
  }

  /** Looks at the whole of it. @param {THREE.Box3} box */
  frame(box) {
    const radius = box.getBoundingSphere(new THREE.Sphere()).radius;
    this.shadow.scale.setScalar(12 * radius);
    this.radius = radius;
    this.controls.target.set(0, 0, 0.1 * radius);
    this.controls.minDistance = 1.2 * radius;
    this.controls.maxDistance = 9 * radius;
    const away = new THREE.Vector3(1.25, -1.55, 0.75).normalize();
    this.camera.position.copy(this.controls.target).addScaledVector(away, this.distance());
    this.key.position.set(1.2 * radius, -1.4 * radius, 3.2 * radius);
    this.fill.position.set(-2 * radius, 2 * radius, 1.5 * radius);
    const camera = this.key.shadow.camera;
    camera.left = camera.bottom = -1.6 * radius;
    camera.right = camera.top = 1.6 * radius;
    camera.near = 0.5 * radius;
    camera.far = 8 * radius;
    camera.updateProjectionMatrix();
  }

  /** From where all of it is in the picture. */
  distance() {
    const half = (this.camera.fov * Math.PI) / 360;
    const aspect = Math.max(this.canvas.clientWidth, 1) / Math.max(this.canvas.clientHeight, 1);
    return (1.02 * (this.radius ?? 1)) / Math.sin(Math.min(half, Math.atan(Math.tan(half) * aspect)));
  }

  /** Moves the bodies to where they are. @param {import("./physics.js").Physics} physics */
  update(physics) {
    const { xpos, xquat } = physics.state;
    this.bodies.forEach((body, k) => {
      body.position.set(xpos[3 * k], xpos[3 * k + 1], xpos[3 * k + 2]);
      body.quaternion.set(xquat[4 * k + 1], xquat[4 * k + 2], xquat[4 * k + 3], xquat[4 * k]);
    });
  }

  /** Directions on the board, along x and y, that are to the right and away in the picture. */
  axes() {
    const away = this.controls.target.clone().sub(this.camera.position).setZ(0).normalize();
    return { right: [away.y, -away.x], away: [away.x, away.y] };
  }

  draw() {
    const width = this.canvas.clientWidth;
    const height = this.canvas.clientHeight;
    const aspect = width / Math.max(height, 1);
    if (Math.abs(aspect - this.camera.aspect) > 1e-3 || this.size !== `${width} ${height}`) {
      this.size = `${width} ${height}`;
      this.renderer.setSize(width, height, false);
      this.camera.aspect = aspect;
      this.camera.updateProjectionMatrix();
    }
    this.controls.update();
    this.renderer.render(this.scene, this.camera);
  }
}

/**
 * @param {import("./physics.js").MuJoCo} mujoco
 * @param {any} model
 * @param {number} k
 */
function drawGeom(mujoco, model, k) {
  const [x, y, z] = model.geom_size.slice(3 * k, 3 * k + 3);
  const material = model.geom_matid[k];
  const rgba = material < 0 ? model.geom_rgba.slice(4 * k, 4 * k + 4) : model.mat_rgba.slice(4 * material, 4 * material + 4);
  const name = material < 0 ? "" : mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_MATERIAL.value, material);
  const geometry = shape(model, k, model.geom_type[k], x, y, z);
  const deck = DECK.test(name);
  const look = new THREE.MeshStandardMaterial({
    color: deck ? 0xffffff : new THREE.Color().setRGB(rgba[0], rgba[1], rgba[2], THREE.SRGBColorSpace),
    roughness: material < 0 ? 0.6 : 1 - 0.8 * model.mat_specular[material],
    metalness: 0.05,
    map: deck ? planks(x / y) : null,
    opacity: rgba[3],
    transparent: rgba[3] < 1,
    flatShading: model.geom_type[k] === MESH,
  });
  const mesh = new THREE.Mesh(geometry, look);
  mesh.castShadow = mesh.receiveShadow = true;
  mesh.position.fromArray(model.geom_pos, 3 * k);
  const [w, i, j, l] = model.geom_quat.slice(4 * k, 4 * k + 4);
  mesh.quaternion.set(i, j, l, w);
  return mesh;
}

/**
 * @param {any} model
 * @param {number} k
 * @param {number} type
 * @param {number} x
 * @param {number} y
 * @param {number} z
 * @returns {THREE.BufferGeometry}
 */
function shape(model, k, type, x, y, z) {
  switch (type) {
    case SPHERE:
      return new THREE.SphereGeometry(x, 32, 16);
    case CAPSULE:
      return new THREE.CapsuleGeometry(x, 2 * y, 12, 24).rotateX(Math.PI / 2);
    case ELLIPSOID:
      return new THREE.SphereGeometry(1, 40, 24).scale(x, y, z);
    case CYLINDER:
      return new THREE.CylinderGeometry(x, x, 2 * y, 40).rotateX(Math.PI / 2);
    case BOX:
      return new THREE.BoxGeometry(2 * x, 2 * y, 2 * z);
    case MESH:
      return meshOf(model, model.geom_dataid[k]);
    default:
      return new THREE.BufferGeometry();
  }
}

/** @param {any} model @param {number} k */
function meshOf(model, k) {
  const first = model.mesh_vertadr[k];
  const start = model.mesh_faceadr[k];
  const geometry = new THREE.BufferGeometry();
  const vertices = model.mesh_vert.slice(3 * first, 3 * (first + model.mesh_vertnum[k]));
  const faces = model.mesh_face.slice(3 * start, 3 * (start + model.mesh_facenum[k]));
  geometry.setAttribute("position", new THREE.BufferAttribute(vertices, 3));
  geometry.setIndex(new THREE.BufferAttribute(new Uint32Array(faces), 1));
  geometry.computeVertexNormals();
  return geometry;
}

/** Wood: planks along x. @param {number} aspect */
function planks(aspect) {
  const canvas = document.createElement("canvas");
  canvas.height = 512;
  canvas.width = Math.round(512 * aspect);
  const context = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
  const rows = 8;
  const height = canvas.height / rows;
  for (let row = 0; row < rows; row++) {
    // The same wood each time: a hash of the place instead of chance.
    const shade = (/** @type {number} */ n) => (Math.sin(12.9898 * (row + 1) + 78.233 * n) * 43758.5453) % 1;
    context.fillStyle = `hsl(${31 + 3 * shade(1)} 40% ${60 + 4 * shade(2)}%)`;
    context.fillRect(0, row * height, canvas.width, height);
    for (let grain = 0; grain < 14; grain++) {
      context.strokeStyle = `hsl(28 38% ${44 + 6 * shade(grain + 3)}% / 0.22)`;
      context.lineWidth = 0.6 + Math.abs(shade(grain + 40));
      const y = row * height + Math.abs(shade(grain + 20)) * height;
      context.beginPath();
      context.moveTo(0, y);
      context.bezierCurveTo(canvas.width / 3, y + 7 * shade(grain + 60), (2 * canvas.width) / 3, y - 7 * shade(grain + 80), canvas.width, y);
      context.stroke();
    }
    context.fillStyle = "hsl(27 40% 33% / 0.7)";
    context.fillRect(0, row * height, canvas.width, 1.5);
  }
  const texture = new THREE.CanvasTexture(canvas);
  texture.colorSpace = THREE.SRGBColorSpace;
  texture.anisotropy = 8;
  return texture;
}
