// `npm ci && npm run build`, in this folder: these files and their libraries -> ../viewer.js, with their licences.
import { build } from "esbuild";
import { readFileSync, writeFileSync } from "node:fs";

const licences = ["three", "three-mesh-bvh"].map((name) => {
  const { version } = JSON.parse(readFileSync(`node_modules/${name}/package.json`, "utf8"));
  return `${name} ${version}\n\n${readFileSync(`node_modules/${name}/LICENSE`, "utf8").trim()}`;
});
const output = process.argv[2] ?? "../viewer.js";
const made = await build({
  entryPoints: ["main.js"], bundle: true, minify: true, write: false, format: "iife", globalName: "scapekit",
  target: "es2022", charset: "utf8", legalComments: "none",
  banner: { js: `/*\nThis file is built from source/ by "npm run build" and holds:\n\n${licences.join("\n\n")}\n*/` },
});
// addresses of the libraries' pages in their messages: nothing is fetched from them, and so they go
const text = made.outputFiles[0].text.replaceAll(/https?:\/\/(?!www\.w3\.org)[^\s"'`)*]+/g, "");
writeFileSync(output, text);
console.log(`${output}: ${(text.length / 1000).toFixed(0)} kB`);
