// What is drawn: a lit floor, bodies with their names, a camera that may follow. The bodies' world has z up, three's y.

import * as THREE from "three";
import { OrbitControls } from "./libraries/three/examples/jsm/controls/OrbitControls.js";
import { GLTFLoader } from "./libraries/three/examples/jsm/loaders/GLTFLoader.js";

const SKY = 0xdfe5ec;
const [SLOW_FPS, LEAST_RATIO] = [32, 0.45]; // frame rate below which fewer pixels are drawn, and the fewest
const SURE_M = [0.03, 0.16]; // deviations of a joint (m) that are drawn in full colour, and palest

export class Scene {
  constructor(canvas) {
    const stated = new URLSearchParams(location.search).get("quality"); // fine or fast; otherwise found out
    const weak = stated ? stated === "fast" : isWeak();
    this.adapts = stated !== "fine";
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: !weak, powerPreference: "high-performance" });
    this.ratio = Math.min(window.devicePixelRatio, weak ? 0.7 : 1.5);
    this.renderer.shadowMap.enabled = true;
    this.renderer.shadowMap.type = weak ? THREE.BasicShadowMap : THREE.PCFShadowMap;
    this.renderer.toneMapping = THREE.ACESFilmicToneMapping;
    this.renderer.toneMappingExposure = 1.15;
    this.scene = new THREE.Scene();
    this.scene.background = new THREE.Color(SKY);
    this.scene.fog = new THREE.Fog(SKY, 9, 26);
    this.camera = new THREE.PerspectiveCamera(38, 1, 0.05, 60);
    this.camera.position.set(2.6, 1.7, 3.6);
    this.controls = new OrbitControls(this.camera, canvas);
    Object.assign(this.controls, { enableDamping: true, maxPolarAngle: 1.54, minDistance: 1, maxDistance: 14 });
    this.controls.target.set(0, 0.95, 0);
    this.scene.add(new THREE.HemisphereLight(0xf4f8ff, 0xa89f92, 1.5));
    this.sun = new THREE.DirectionalLight(0xfff1de, 2.2);
    this.sun.castShadow = true;
    this.sun.shadow.mapSize.setScalar(weak ? 512 : 1024);
    Object.assign(this.sun.shadow.camera, { left: -2.6, right: 2.6, top: 2.6, bottom: -2.6, near: 1, far: 14 });
    Object.assign(this.sun.shadow, { bias: -5e-4, normalBias: 0.02, radius: 4 });
    this.floor = new THREE.Mesh(
      new THREE.CircleGeometry(40, 48),
      new THREE.MeshLambertMaterial({ map: tiles(weak ? 1 : 8) }),
    );
    this.floor.rotation.x = -Math.PI / 2;
    this.floor.receiveShadow = true;
    this.stage = new THREE.Group(); // what a mirror may turn round
    this.scene.add(this.sun, this.sun.target, this.floor, this.stage);
    this.follow = true;
    this.focus = new THREE.Vector3(0, 0.95, 0);
  }

  resize() {
    const { clientWidth, clientHeight } = this.renderer.domElement;
    this.renderer.setPixelRatio(this.ratio);
    this.renderer.setSize(clientWidth, clientHeight, false);
    this.camera.aspect = clientWidth / Math.max(clientHeight, 1);
    this.camera.fov = this.camera.aspect < 1 ? 56 : 38;
    this.camera.updateProjectionMatrix();
  }

  // Move along with a place (three's axes) within some time (s).
  track(place, elapsed) {
    const goal = place.clone().setY(Math.max(0.5, place.y * 0.9));
    const share = this.follow ? 1 - Math.exp(-5 * elapsed) : 0;
    const step = goal.sub(this.focus).multiplyScalar(share);
    this.focus.add(step);
    this.camera.position.add(step);
    this.controls.target.add(step);
    this.light(place);
  }

  light(place) {
    this.sun.target.position.set(place.x, 0.6, place.z);
    this.sun.position.set(place.x + 2.4, 6, place.z + 2.2);
  }

  // Fewer pixels where the last second's frames were too few, and at last no shadows.
  adapt(rate) {
    if (!this.adapts || rate >= SLOW_FPS || this.renderer.xr.isPresenting) return;
    if (this.ratio <= LEAST_RATIO) this.sun.castShadow = false;
    this.ratio = Math.max(LEAST_RATIO, 0.85 * this.ratio);
    this.resize();
  }

  draw() {
    if (!this.renderer.xr.isPresenting) this.controls.update();
    this.renderer.render(this.scene, this.camera);
  }
}

function tiles(anisotropy) {
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = 256;
  const pen = canvas.getContext("2d");
  pen.fillStyle = "#c9cdd1";
  pen.fillRect(0, 0, 256, 256);
  pen.fillStyle = "#c1c6cb";
  pen.fillRect(0, 0, 128, 128);
  pen.fillRect(128, 128, 128, 128);
  const texture = new THREE.CanvasTexture(canvas);
  texture.colorSpace = THREE.SRGBColorSpace;
  texture.wrapS = texture.wrapT = THREE.RepeatWrapping;
  texture.repeat.set(40, 40); // squares of one metre
  texture.anisotropy = anisotropy;
  return texture;
}

// Whether a processor draws in a graphics card's place.
function isWeak() {
  const gl = document.createElement("canvas").getContext("webgl2");
  const about = gl?.getExtension("WEBGL_debug_renderer_info");
  return /swiftshader|llvmpipe|software|basic render/i.test(about ? gl.getParameter(about.UNMASKED_RENDERER_WEBGL) : "");
}

// A skinned body from a .glb that `wearcap export` wrote, with its name above it.
export class Body {
  static async load(url, name, color) {
    const { scene, animations } = await new GLTFLoader().loadAsync(url);
    return new Body(scene, animations, name, color);
  }

  constructor(root, animations, name, color) {
    this.group = new THREE.Group();
    this.group.add(root);
    root.traverse((node) => {
      if (node.isSkinnedMesh) this.mesh = node;
    });
    this.bones = this.mesh.skeleton.bones;
    this.sure = new Float32Array(this.bones.length);
    Object.assign(this.mesh, { castShadow: true, receiveShadow: true, frustumCulled: false });
    this.mesh.material = skin(color, this.sure);
    this.size = 1;
    if (animations.length) {
      this.mixer = new THREE.AnimationMixer(root);
      this.mixer.clipAction(animations[0]).play();
      this.duration = animations[0].duration;
    }
    this.label = name && sign(name, color);
    if (this.label) this.group.add(this.label);
  }

  // The body's own animation at a time (s) from its start.
  play(time) {
    this.mixer.setTime(Math.min(Math.max(time, 0), this.duration - 1e-4));
    this.#place();
  }

  // A pose: the root's place (m), quaternions of all joints one after the other, deviations of the joints (m).
  pose(root, quats, deviations) {
    this.bones.forEach((bone, k) => bone.quaternion.fromArray(quats, 4 * k));
    this.bones[0].position.fromArray(root).divideScalar(this.size);
    this.bones.forEach((_, k) => {
      this.sure[k] = Math.min(Math.max((deviations[k] - SURE_M[0]) / (SURE_M[1] - SURE_M[0]), 0), 1);
    });
    this.#place();
  }

  scale(size) {
    this.size = size;
    this.group.children[0].scale.setScalar(size);
  }

  #place() {
    if (!this.label) return;
    const { x, y, z } = this.bones[0].position;
    this.label.position.set(x * this.size, z * this.size + 1.02 * Math.max(this.size, 0.7), -y * this.size);
  }

  // The root's place in three's axes, within the stage.
  get place() {
    const { x, y, z } = this.bones[0].position;
    return new THREE.Vector3(x, z, -y).multiplyScalar(this.size).add(this.group.position);
  }

  remove() {
    this.group.removeFromParent();
    this.mesh.geometry.dispose();
  }
}

// Skin that is paler where the network is less sure of the joints.
function skin(color, sure) {
  const material = new THREE.MeshStandardMaterial({ color, roughness: 0.62, metalness: 0 });
  material.onBeforeCompile = (shader) => {
    shader.uniforms.sure = { value: sure };
    shader.vertexShader = shader.vertexShader
      .replace("void main() {", `uniform float sure[${sure.length}];\nvarying float pale;\nvoid main() {`)
      .replace("#include <skinning_vertex>", `#include <skinning_vertex>
        pale = 0.0;
        for (int k = 0; k < 4; k++) pale += skinWeight[k] * sure[int(skinIndex[k])];`);
    shader.fragmentShader = shader.fragmentShader
      .replace("void main() {", "varying float pale;\nvoid main() {")
      .replace("#include <color_fragment>", "#include <color_fragment>\ndiffuseColor.rgb = mix(diffuseColor.rgb, vec3(0.86, 0.89, 0.93), 0.8 * pale);");
  };
  return material;
}

function sign(text, color) {
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [512, 96];
  const pen = canvas.getContext("2d");
  pen.font = "600 46px system-ui, sans-serif";
  const width = pen.measureText(text).width + 56;
  pen.fillStyle = "rgba(255, 255, 255, 0.82)";
  pen.beginPath();
  pen.roundRect(256 - width / 2, 12, width, 72, 36);
  pen.fill();
  pen.fillStyle = new THREE.Color(color).multiplyScalar(0.55).getStyle();
  pen.textAlign = "center";
  pen.fillText(text, 256, 64);
  const texture = new THREE.CanvasTexture(canvas);
  texture.colorSpace = THREE.SRGBColorSpace;
  const label = new THREE.Sprite(new THREE.SpriteMaterial({ map: texture, depthWrite: false, fog: false }));
  label.scale.set(0.8, 0.15, 1);
  return label;
}
