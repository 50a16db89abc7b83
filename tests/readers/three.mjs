// Prints what three.js' GLTFLoader makes of each file named on the command line, a JSON line each.
import fs from 'node:fs';
import path from 'node:path';
import { MeshoptDecoder } from 'meshoptimizer';
import { read } from './basis.mjs';

// What the loader expects of a browser. Images are not decoded: their headers must be those of an image.
globalThis.self = globalThis;
globalThis.ProgressEvent ??= class extends Event {};
globalThis.createImageBitmap = async (blob) => {
  const bytes = Buffer.from(await blob.arrayBuffer());
  const known = ['89504e470d0a1a0a', 'ffd8ff', '52494646'].some((head) => bytes.toString('hex', 0, 8).startsWith(head));
  if (!known) throw new Error(`an image of ${bytes.length} bytes is neither PNG, JPEG nor WebP`);
  return { width: 1, height: 1, close() {} };
};
const HOST = 'http://files/';
let folder = '.';
const browserFetch = globalThis.fetch;
globalThis.fetch = async (request, options) => {
  const url = typeof request === 'string' ? request : request.url;
  if (!url.startsWith(HOST)) return browserFetch(request, options);
  return new Response(fs.readFileSync(path.join(folder, decodeURIComponent(new URL(url).pathname))));
};

// Loaded after the stubs: the loader looks at its surroundings once.
const { Box3, Loader, Texture } = await import('three');
const { GLTFLoader } = await import('three/addons/loaders/GLTFLoader.js');

// Three's own loader hands the same transcoder to a worker, and its textures to a graphics card.
class BasisLoader extends Loader {
  load(url, onLoad, onProgress, onError) {
    const texture = async () => {
      const { width, height } = await read(await (await fetch(url)).arrayBuffer());
      return new Texture({ width, height });
    };
    texture().then(onLoad, onError);
  }
}

const SLOTS = (material) => Object.keys(material).filter((key) => /[mM]ap$/.test(key) && material[key] !== null);

async function summary(file) {
  folder = path.dirname(file);
  const complaints = [];
  for (const level of ['warn', 'error']) console[level] = (...words) => complaints.push(words.join(' '));
  const loader = new GLTFLoader().setMeshoptDecoder(MeshoptDecoder).setKTX2Loader(new BasisLoader()).setPath(HOST);
  const bytes = fs.readFileSync(file);
  const gltf = await loader.parseAsync(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength), HOST);
  const result = { drawn: 0, triangles: 0, morphs: 0, skinned: 0, bones: 0, textures: 0, broken: [] };
  const materials = new Set();
  const textures = new Set();
  const infinite = (name, array) => {
    if (!array.every(Number.isFinite)) result.broken.push(`${name} holds numbers that are not finite`);
  };
  for (const scene of gltf.scenes) {
    scene.updateMatrixWorld(true);
    const box = new Box3().setFromObject(scene);
    if (result.drawn && ![...box.min.toArray(), ...box.max.toArray()].every(Number.isFinite)) result.broken.push('the bounding box is not finite');
    scene.traverse((object) => {
      infinite(`the matrix of ${object.name}`, object.matrixWorld.elements);
      if (object.isBone) result.bones += 1;
      if (!object.isMesh) return;
      result.drawn += 1;
      if (object.isSkinnedMesh) result.skinned += 1;
      const { attributes, index, morphAttributes } = object.geometry;
      const corners = (index ?? attributes.position).count;
      result.triangles += corners / 3;
      for (const [name, attribute] of Object.entries(attributes)) {
        infinite(`${object.name}.${name}`, attribute.array ?? attribute.data.array);
        if (attribute.count !== attributes.position.count) result.broken.push(`${object.name}.${name} has ${attribute.count} elements`);
      }
      if (index && index.array.some((i) => i >= attributes.position.count)) result.broken.push(`${object.name} has an index out of range`);
      for (const [name, targets] of Object.entries(morphAttributes)) {
        if (name === 'position') result.morphs += targets.length;
        targets.forEach((target) => infinite(`a morph target of ${object.name}.${name}`, target.array ?? target.data.array));
      }
      for (const material of [object.material].flat()) {
        materials.add(material.name + SLOTS(material).map((key) => material[key].uuid));
        SLOTS(material).forEach((key) => textures.add(material[key]));
      }
    });
  }
  for (const texture of textures) if (!texture.image) result.broken.push(`the texture ${texture.name} has no image`);
  const channels = gltf.animations.flatMap((clip) => clip.tracks);
  channels.forEach((track) => infinite(`the track ${track.name}`, track.values));
  return { ...result, materials: materials.size, textures: textures.size, animations: gltf.animations.length, channels: channels.length, complaints };
}

for (const file of process.argv.slice(2)) {
  const line = await summary(file).catch((error) => ({ broken: [String(error?.message ?? error)] }));
  process.stdout.write(`${JSON.stringify({ file, ...line })}\n`);
}
