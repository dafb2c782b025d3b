"""What `ibi_rs.plot.html` puts around the picture of Plotly: a list of the poses, and switches."""

from __future__ import annotations

import html
import json
from typing import Any

STYLE = """
html, body { height: 100%; margin: 0; color: #222; background: #fff }
body { font: 14px/1.45 system-ui, sans-serif }
body { display: flex }
aside { width: 19em; flex: none; padding: 1em; box-sizing: border-box; overflow: auto }
main { flex: 1; min-width: 0 }
main > div, main .plotly-graph-div { height: 100% !important; width: 100% !important }
h1 { font-size: 1.15em; margin: 0 0 .2em } p { margin: .2em 0 .8em; color: #555 }
label { display: block; cursor: pointer } input[type=number] { width: 5em }
ol { list-style: none; margin: .6em 0; padding: 0; border-top: 1px solid #eee }
li { padding: .15em .4em; cursor: pointer; display: flex; gap: .5em; border-bottom: 1px solid #f0f0f0 }
li[hidden] { display: none }
li:hover { background: #f5f5f5 } li.picked { background: #e3eefc } li.hidden { opacity: .35 }
li i { width: .9em; height: .9em; align-self: center; border-radius: 50%; flex: none }
li b { min-width: 2em; text-align: right } li span { flex: 1; overflow-wrap: anywhere; color: #555 }
dl { display: grid; grid-template-columns: auto 1fr; gap: 0 .8em; margin: .6em 0; font-size: .92em }
dt { color: #777 } dd { margin: 0; font-variant-numeric: tabular-nums; overflow-wrap: anywhere }
"""

SCRIPT = """
const by = id => document.getElementById(id);
const plot = document.querySelector('.plotly-graph-div'), page = JSON.parse(by('page').textContent);
let picked = null;
function isShown(pose) {
  return pose.score >= Number(by('least').value || 0) && (!pose.rejected || by('rejected').checked);
}
function draw() {
  const rows = [], seen = [], opacity = [];
  for (const pose of page.poses) {
    rows.push(pose.trace); seen.push(isShown(pose));
    opacity.push(picked === null || picked === pose ? 1 : 0.12);
    pose.row.hidden = !!pose.rejected && !by('rejected').checked;
    pose.row.classList.toggle('hidden', !isShown(pose));
    pose.row.classList.toggle('picked', picked === pose);
  }
  const labels = page.poses.map(pose => isShown(pose) ? pose.label : '');
  if (rows.length) Plotly.restyle(plot, { visible: seen, opacity: opacity }, rows);
  Plotly.restyle(plot, { visible: [by('scene').checked] }, [page.scene]);
  if (page.labels !== null) {
    Plotly.restyle(plot, { text: [labels], visible: [by('numbers').checked] }, [page.labels]);
  }
  by('facts').replaceChildren();
  for (const [name, value] of picked ? picked.facts : []) {
    const term = document.createElement('dt'), text = document.createElement('dd');
    term.textContent = name; text.textContent = value; by('facts').append(term, text);
  }
}
function pick(pose) {
  picked = picked === pose ? null : pose;
  by('number').value = picked && !picked.rejected ? picked.label : '';
  draw();
  if (picked) picked.row.scrollIntoView({ block: 'nearest' });
}
for (const pose of page.poses) {
  const row = pose.row = document.createElement('li');
  const texts = [['i', ''], ['b', pose.label], ['span', pose.name], ['em', pose.score.toFixed(2)]];
  for (const [tag, text] of texts) {
    const part = document.createElement(tag);
    part.textContent = text; row.append(part);
  }
  row.firstChild.style.background = pose.colour;
  row.title = pose.rejected || '';
  row.onclick = () => pick(pose);
  by('poses').append(row);
}
for (const id of ['scene', 'numbers', 'rejected', 'least']) by(id).oninput = draw;
by('number').oninput = event => {
  picked = page.poses.find(pose => !pose.rejected && pose.label === event.target.value) || null;
  draw();
  if (picked) picked.row.scrollIntoView({ block: 'nearest' });
};
plot.on('plotly_click', event => {
  const pose = page.poses.find(pose => pose.trace === event.points[0].curveNumber);
  if (pose) pick(pose);
});
draw();
document.body.dataset.ready = 'yes';
"""


def page(figure: str, title: str, subtitle: str, data: dict[str, Any], num_rejected: int) -> str:
    """Return a file that needs nothing else: `figure` brings Plotly's script."""
    held = json.dumps(data).replace("<", "\\u003c")
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>
<meta name="viewport" content="width=device-width, initial-scale=1"><style>{STYLE}</style></head>
<body><aside><h1>{html.escape(title)}</h1><p>{html.escape(subtitle)}</p>
<label><input type="checkbox" id="scene" checked> scene</label>
<label><input type="checkbox" id="numbers" checked> numbers</label>
<label><input type="checkbox" id="rejected"> rejected poses ({num_rejected})</label>
<label>score at least <input type="number" id="least" min="0" max="1" step="0.05" value="0"></label>
<label>pick number <input type="number" id="number" min="0" step="1"></label>
<dl id="facts"></dl><ol id="poses"></ol></aside>
<main>{figure}</main>
<script type="application/json" id="page">{held}</script><script>{SCRIPT}</script></body></html>
"""
