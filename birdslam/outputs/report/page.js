"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const slider = document.getElementById("at");
const words = document.getElementById("words");
const picture = document.getElementById("picture");
const dark = window.matchMedia("(prefers-color-scheme: dark)");
const config = { responsive: true, displaylogo: false, scrollZoom: true };
const here = { name: "now", type: "scatter", mode: "markers", x: [data.x[0]], y: [data.y[0]], hoverinfo: "skip",
  marker: { size: 15, symbol: "circle-open", line: { width: 3 }, color: "#e8487f" } };

const below = { orientation: "h", yref: "container", y: 0, yanchor: "bottom" };

function layout(more) {
  const style = getComputedStyle(document.documentElement);
  const [ink, line, faint] = ["--ink", "--line", "--faint"].map((name) => style.getPropertyValue(name).trim());
  const axis = { gridcolor: line, zerolinecolor: line, automargin: true };
  const out = { paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", font: { color: ink },
    margin: { l: 60, r: 15, t: 40, b: 60 }, modebar: { bgcolor: "rgba(0,0,0,0)", color: faint, activecolor: ink }, ...more };
  out.title = { text: more.title, font: { size: 14 }, x: 0.01, xanchor: "left" };
  out.xaxis = { ...axis, ...more.xaxis };
  out.yaxis = { ...axis, ...more.yaxis };
  return out;
}

const last = data.t[data.t.length - 1];
const moment = (t) => [{ type: "line", x0: t, x1: t, yref: "paper", y0: 0, y1: 1,
  line: { color: "#e8487f", width: 2 } }];

function draw() {
  const time = { title: { text: "time (s)" }, range: [0, last] };
  Plotly.react("map", [...data.map, here], layout({
    title: "from above", legend: below,
    xaxis: { title: { text: "right of the start (m)" } },
    yaxis: { title: { text: "ahead of the start (m)" }, scaleanchor: "x", scaleratio: 1 } }), config);
  Plotly.react("speed", data.speeds, layout({
    title: "speed (m/s)", legend: below,
    xaxis: time, yaxis: { rangemode: "tozero" }, shapes: moment(data.t[slider.value]) }), config);
  Plotly.react("statuses", data.statuses, layout({
    title: "statuses", xaxis: time, shapes: moment(data.t[slider.value]),
    yaxis: { automargin: true, autorange: "reversed", type: "category" } }), config);
}

function move() {
  const k = Number(slider.value);
  here.x = [data.x[k]];
  here.y = [data.y[k]];
  words.textContent = new DOMParser().parseFromString(data.words[k], "text/html").documentElement.textContent;
  Plotly.restyle("map", { x: [here.x], y: [here.y] }, [data.map.length]);
  for (const name of ["speed", "statuses"]) Plotly.relayout(name, { shapes: moment(data.t[k]) });
  if (picture && data.pictures.length) {
    let at = 0;
    while (at + 1 < data.pictures.length && data.pictures[at + 1].t <= data.t[k]) at += 1;
    picture.src = `data:image/jpeg;base64,${data.pictures[at].jpeg}`;
  }
}

slider.max = String(data.t.length - 1);
slider.addEventListener("input", move);
dark.addEventListener("change", draw);
document.getElementById("statuses").style.height = `${160 + 26 * Math.max(1, data.statuses.length)}px`;
draw();
move();
for (const name of ["map", "speed"]) {
  document.getElementById(name).on("plotly_click", (event) => {
    const point = event.points[0];
    let best = 0;
    data.t.forEach((t, k) => {
      const far = (i) => name === "speed" ? Math.abs(data.t[i] - point.x)
        : Math.hypot(data.x[i] - point.x, data.y[i] - point.y);
      if (far(k) < far(best)) best = k;
    });
    slider.value = String(best);
    move();
  });
}
document.documentElement.dataset.ready = "yes";
