"""The page at /docs: the operations of /openapi.json, with nothing loaded from anywhere else."""

import base64
import hashlib
import re
from typing import Final

__all__ = ["DOCS_HEADERS", "DOCS_PAGE"]

DOCS_PAGE: Final = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Trompe API</title>
<style>
  body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; color: #222; }
  code, pre { font: 14px/1.4 ui-monospace, monospace; background: #f4f4f4; padding: .1rem .3rem; }
  pre { padding: .6rem; overflow: auto; }
  details { border-top: 1px solid #ddd; padding: .4rem 0; }
  summary { cursor: pointer; }
  summary b { display: inline-block; width: 4rem; }
  @media (prefers-color-scheme: dark) { body { background: #181818; color: #ddd; } code, pre { background: #262626; } }
</style>
<h1>Trompe API</h1>
<p id="description"></p>
<p>The whole contract: <a href="/openapi.json">/openapi.json</a>.</p>
<main id="operations"></main>
<h2>Schemas</h2>
<section id="schemas"></section>
<script>
  const element = (tag, text) => Object.assign(document.createElement(tag), { textContent: text });
  const fold = (title, ...content) => {
    const details = document.createElement("details");
    details.append(title, ...content);
    return details;
  };
  const operation = (path, method, spec) => {
    const title = document.createElement("summary");
    title.append(element("b", method.toUpperCase()), element("code", path), " " + spec.description);
    const inputs = (spec.parameters || []).map((p) => `${p.in} ${p.name}: ${p.description || ""}`);
    const body = spec.requestBody ? JSON.stringify(spec.requestBody.content, null, 2) : "";
    const answers = Object.entries(spec.responses).map(([status, answer]) => `${status}: ${answer.description}`);
    return fold(title, element("pre", [...inputs, body, ...answers].filter(Boolean).join("\\n")));
  };
  fetch("/openapi.json").then((answer) => answer.json()).then((api) => {
    document.getElementById("description").textContent = api.info.description;
    for (const [path, methods] of Object.entries(api.paths))
      for (const [method, spec] of Object.entries(methods))
        document.getElementById("operations").append(operation(path, method, spec));
    for (const [name, schema] of Object.entries(api.components.schemas))
      document.getElementById("schemas").append(
        fold(element("summary", name), element("pre", JSON.stringify(schema, null, 2))));
  });
</script>
</html>
"""


def _source(tag: str) -> str:
    """The one inline element ``tag`` of the page, as a source that a content security policy allows by its hash."""
    match = re.search(f"<{tag}>(.*?)</{tag}>", DOCS_PAGE, re.DOTALL)
    assert match is not None
    return f"'sha256-{base64.b64encode(hashlib.sha256(match[1].encode()).digest()).decode()}'"


DOCS_HEADERS: Final = {
    "Content-Security-Policy": "default-src 'none'; connect-src 'self'; frame-ancestors 'none'; base-uri 'none'; "
    f"form-action 'none'; script-src {_source('script')}; style-src {_source('style')}"
}
