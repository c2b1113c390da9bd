// Plays a .vrma on a VRM humanoid with three-vrm, and prints the bones' world positions at times:
// node play_vrma.mjs FILE HUMANOID.json → [{bone: [x, y, z]}] as JSON. Needs node_modules beside it.
import { readFileSync } from "node:fs";
import * as THREE from "three";
import { GLTFLoader } from "three/examples/jsm/loaders/GLTFLoader.js";
import { VRMHumanoid } from "@pixiv/three-vrm";
import { VRMAnimationLoaderPlugin, createVRMAnimationClip } from "@pixiv/three-vrm-animation";

globalThis.self ??= globalThis;
console.warn = (...message) => { throw new Error(message.join(" ")); };

const content = readFileSync(process.argv[2]);
const { bones, times } = JSON.parse(readFileSync(process.argv[3]));
const loader = new GLTFLoader();
loader.register((parser) => new VRMAnimationLoaderPlugin(parser));
const buffer = content.buffer.slice(content.byteOffset, content.byteOffset + content.byteLength);
const gltf = await loader.parseAsync(buffer, "");
const [animation] = gltf.userData.vrmAnimations;

// An avatar whose bones have axes of their own: `turn` is a bone's rotation in the world at rest.
const scene = new THREE.Group();
const nodes = {};
for (const { name, parent, place, turn } of bones) {
  const node = (nodes[name] = { node: new THREE.Object3D() }).node;
  const above = parent === null ? scene : nodes[parent].node;
  node.name = `avatar_${name}`;
  above.add(node);
  above.updateWorldMatrix(true, false);
  const world = new THREE.Matrix4().compose(
    new THREE.Vector3(...place), new THREE.Quaternion(...turn), new THREE.Vector3(1, 1, 1));
  above.matrixWorld.clone().invert().multiply(world).decompose(node.position, node.quaternion, node.scale);
}
const humanoid = new VRMHumanoid(nodes);
scene.add(humanoid.normalizedHumanBonesRoot);
const clip = createVRMAnimationClip(animation, { humanoid, scene, meta: { metaVersion: "1" } });
const mixer = new THREE.AnimationMixer(humanoid.normalizedHumanBonesRoot);
mixer.clipAction(clip).play();
const found = times.map((time) => {
  mixer.setTime(time);
  humanoid.update();
  scene.updateMatrixWorld(true);
  const places = Object.entries(nodes).map(([name, { node }]) => [name, node.getWorldPosition(new THREE.Vector3()).toArray()]);
  return Object.fromEntries(places);
});
console.log(JSON.stringify({ places: found, duration: clip.duration, tracks: clip.tracks.length }));
