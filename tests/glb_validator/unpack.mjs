// Unpacks a GLB with EXT_meshopt_compression by meshoptimizer's own decoder, as a viewer does: node unpack.mjs FILE
// Prints JSON: for each primitive its view, places (after the nodes' scale and translation, not their turn, in the root's
// units), texture coordinates and indices, in base64 of float64, float64 and uint32.
import { readFile } from "node:fs/promises";
import { MeshoptDecoder } from "meshoptimizer/decoder";

await MeshoptDecoder.ready;
const file = await readFile(process.argv[2]);
const jsonLength = file.readUInt32LE(12);
const gltf = JSON.parse(file.subarray(20, 20 + jsonLength).toString("utf8"));
const binary = file.subarray(28 + jsonLength);
const NAME = "EXT_meshopt_compression";
const WIDTH = { SCALAR: 1, VEC2: 2, VEC3: 3 };

function bytes(view) {
  const how = view.extensions[NAME];
  const out = new Uint8Array(how.count * how.byteStride);
  const packed = binary.subarray(how.byteOffset, how.byteOffset + how.byteLength);
  MeshoptDecoder.decodeGltfBuffer(out, how.count, how.byteStride, packed, how.mode, how.filter);
  if (out.length !== view.byteLength) throw new Error("the view has another length");
  return { out, stride: how.byteStride };
}

function rows(index) {
  const accessor = gltf.accessors[index];
  const { out, stride } = bytes(gltf.bufferViews[accessor.bufferView]);
  const size = accessor.componentType === 5125 ? 4 : 2;
  const step = accessor.type === "SCALAR" ? size : stride;
  const see = new DataView(out.buffer);
  const values = [];
  for (let i = 0; i < accessor.count; i++)
    for (let k = 0; k < WIDTH[accessor.type]; k++) {
      const at = i * step + k * size;
      const value = size === 4 ? see.getUint32(at, true) : see.getUint16(at, true);
      values.push(accessor.normalized ? value / 65535 : value);
    }
  return values;
}

const base64 = (array) => Buffer.from(array.buffer).toString("base64");
const node = gltf.nodes.find((n) => n.mesh === 0);
const out = gltf.meshes[0].primitives.map((p) => {
  const places = rows(p.attributes.POSITION).map((v, i) => v * node.scale[i % 3] + node.translation[i % 3]);
  return {
    view: p.extras.view,
    places: base64(Float64Array.from(places)),
    uv: base64(Float64Array.from(rows(p.attributes.TEXCOORD_0))),
    indices: base64(Uint32Array.from(rows(p.indices))),
  };
});
console.log(JSON.stringify(out));
