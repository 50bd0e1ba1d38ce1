"""What the page of a report looks like, and how its figures come to life: when they are first seen."""

STYLE = """
:root{color-scheme:light}
body{margin:0 auto;padding:1.5rem 1.25rem 4rem;max-width:1120px;background:#fff;color:#222;
 font:15px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,sans-serif}
h1{font-size:1.7rem;margin:.2rem 0 .6rem}
h2{font-size:1.2rem;margin:2.2rem 0 .3rem;border-bottom:1px solid #ccc;padding-bottom:.2rem}
h3{font-size:1rem;margin:1.6rem 0 .2rem}
p{max-width:78ch;margin:.4rem 0}
.note{color:#555}
.wide{overflow-x:auto}
table{border-collapse:collapse;margin:.6rem 0}
th,td{padding:.22rem .8rem;text-align:right;border-bottom:1px solid #e4e4e4;font-variant-numeric:tabular-nums}
th:first-child,td:first-child{text-align:left;font-weight:normal}
thead th{border-bottom:2px solid #888}
td.best{font-weight:700}
td.best::after{content:" \\2713"}
details{margin:1rem 0;border:1px solid #ccc;border-radius:6px;padding:.2rem 1rem}
summary{cursor:pointer;font-size:1.2rem;font-weight:600;padding:.5rem 0}
.views{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(460px,100%),1fr));gap:.8rem}
.views figure{margin:0}
.views svg{width:100%;display:block;border-radius:4px}
figcaption{color:#555;font-size:.85rem}
.box{fill:none;stroke:#ffd400;stroke-width:1.5}
.own{fill:#ffd40044;stroke:#ffd400;stroke-width:1.5}
.heuristic{fill:none;stroke:#4fc3ff;stroke-width:1.5;stroke-dasharray:6 4}
.quadric{fill:none;stroke:#fff;stroke-width:1.2;stroke-dasharray:1.5 2.5}
.rim{fill:none;stroke:#000;stroke-width:3;opacity:.4}
.name{font:11px system-ui,sans-serif;fill:#fff;paint-order:stroke;stroke:#000;stroke-width:3px}
@media print{details{border:0}}
"""

SCRIPT = """
"use strict";
const drawn = new WeakSet();
function draw(root) {
  for (const place of root.querySelectorAll("[data-figure]")) {
    const details = place.closest("details");
    if (drawn.has(place) || (details && !details.open)) continue;
    drawn.add(place);
    const figure = JSON.parse(document.getElementById(place.dataset.figure).textContent);
    Plotly.newPlot(place, figure.data, figure.layout, {responsive: true, displaylogo: false});
  }
}
draw(document);
for (const details of document.querySelectorAll("details")) details.addEventListener("toggle", () => draw(details));
addEventListener("beforeprint", () => {
  for (const details of document.querySelectorAll("details")) details.open = true;
  draw(document);
});
"""
