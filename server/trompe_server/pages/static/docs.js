// The operations and schemas of /openapi.json, each in a fold.
import { ask } from "./common.js";

const element = (tag, ...content) => {
  const made = document.createElement(tag);
  made.append(...content);
  return made;
};
const fold = (title, text) => element("details", element("summary", ...title), element("pre", text));
const put = (place, ...folds) => document.getElementById(place).append(...folds);

const api = await ask("/openapi.json");
put("description", api.info.description);
for (const [path, methods] of Object.entries(api.paths))
  for (const [method, spec] of Object.entries(methods)) {
    const inputs = (spec.parameters || []).map((each) => `${each.in} ${each.name}: ${each.description || ""}`);
    const body = spec.requestBody ? JSON.stringify(spec.requestBody.content, null, 2) : "";
    const answers = Object.entries(spec.responses).map(([status, answer]) => `${status}: ${answer.description}`);
    const title = [element("b", method.toUpperCase()), " ", element("code", path), ` ${spec.description}`];
    put("operations", fold(title, [...inputs, body, ...answers].filter(Boolean).join("\n")));
  }
for (const [name, schema] of Object.entries(api.components.schemas)) put("schemas", fold([name], JSON.stringify(schema, null, 2)));
