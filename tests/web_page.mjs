// The page's modules under node, for tests: node web_page.mjs PAGE NODE_MODULES COMMAND …; prints JSON.

import fs from "node:fs";
import path from "node:path";
import { pathToFileURL } from "node:url";

const [page, modules, command, ...rest] = process.argv.slice(2);
const load = (...parts) => import(pathToFileURL(path.resolve(...parts)).href);
const json = (name) => JSON.parse(fs.readFileSync(path.join(page, name), "utf-8"));

const COMMANDS = {
  async noise(seed, count) {
    const { Generator } = await load(page, "noise.js");
    const random = new Generator(Number(seed));
    return [0, 1].map(() => Array.from(random.randn(Number(count))));
  },

  async read(file, how = "{}") {
    const { readRecording } = await load(page, "recordings.js");
    return readRecording(path.basename(file), fs.readFileSync(file), json("network.json"), JSON.parse(how));
  },

  // Places of all joints in the sample's capture, with or without its wrists, pushed in pieces.
  async capture(hands) {
    const [{ Session }, { Skeleton }, { ofQuat }, ort] = await Promise.all([
      load(page, "session.js"), load(page, "body.js"), load(page, "rotation.js"),
      load(modules, "onnxruntime-web/dist/ort.node.min.mjs"),
    ]);
    ort.env.wasm.numThreads = 1;
    const [about, sample] = [json("network.json"), json("sample.json")];
    const network = await ort.InferenceSession.create(fs.readFileSync(path.join(page, "network.onnx")));
    const run = async (inputs) => {
      const feeds = {};
      for (const [name, [values, shape]] of Object.entries(inputs)) {
        feeds[name] = new ort.Tensor(values instanceof Uint8Array ? "bool" : "float32", values, shape);
      }
      return (await network.run(feeds))[network.outputNames[0]].data;
    };
    const pose = ([x, y, z, ...quat]) => ({ R: ofQuat(quat), t: [x, y, z] });
    const skeleton = new Skeleton(sample.skeleton);
    const session = new Session(about, run, { skeleton, mount: sample.mount });
    const wrists = ["left_wrist", "right_wrist"].map((joint) => sample.wrists[joint]);
    const frames = [];
    for (const [k, time] of sample.head.times.entries()) {
      const seen = wrists.map((track) => (hands === "true" && k < track.poses.length ? pose(track.poses[k]) : null));
      session.push({ time, head: pose(sample.head.poses[k]), wrists: seen });
      if (k % 7 === 0) frames.push(...(await session.advance()));
    }
    frames.push(...(await session.advance(true)));
    return frames.map(({ time, local, root, contact }) => ({ time, contact, joints: skeleton.forward(local, root).t }));
  },
};

try {
  const text = JSON.stringify(await COMMANDS[command](...rest));
  process.stdout.write(text);
} catch (error) {
  console.error(error.message);
  process.exitCode = 1;
}
