// Prints Khronos' validation report of a .glb or .gltf file as JSON: node validate.mjs FILE
// Status 0 if the file has no error, 1 if it has, 2 if it cannot be judged.
import { readFileSync } from "node:fs";
import { createRequire } from "node:module";
import { pathToFileURL } from "node:url";

const modules = process.env.GLTF_VALIDATOR_MODULES ?? new URL("../../build/gltf_validator/", import.meta.url).pathname;
const file = process.argv[2];
try {
  const validator = createRequire(pathToFileURL(`${modules}/package.json`))("gltf-validator");
  const report = await validator.validateBytes(new Uint8Array(readFileSync(file)), { maxIssues: 200 });
  console.log(JSON.stringify(report, null, 1));
  process.exitCode = report.issues.numErrors > 0 ? 1 : 0;
} catch (error) {
  console.error(String(error.message ?? error).split("\n")[0]);
  process.exitCode = 2;
}
