(() => {
  const report = JSON.parse(document.getElementById("data").textContent);
  const { Player, at, config, coordinates, element, number, returnRow, stillness } = explorer;
  const { runs, objectives } = report;
  const selected = { run: 0, point: 0 };
  const player = new Player(report.fps);

  const weights = (run, point) =>
    run.preferences === null ? `solution ${point + 1}` : run.preferences[point].map((w) => w.toFixed(2)).join(" / ");

  function describe(run, point) {
    if (run.preferences === null) return `solution ${point + 1}`;
    return run.preferences[point].map((w, i) => `${w.toFixed(2)} ${objectives[i]}`).join(", ");
  }

  // Where the slider stops: at what was filmed, or else at every point.
  const stops = (run) => (run.films.length > 0 ? run.films.map((one) => one.point) : run.values.map((_, i) => i));

  function nearest(run, point, candidates) {
    if (run.preferences === null || candidates.includes(point)) return Math.max(candidates.indexOf(point), 0);
    const distances = candidates.map((other) =>
      run.preferences[other].reduce((sum, w, i) => sum + (w - run.preferences[point][i]) ** 2, 0));
    return distances.indexOf(Math.min(...distances));
  }

  function mark() {
    const run = runs[selected.run];
    Plotly.restyle("front", coordinates(run.values[selected.point], report.ranges), [report.charts.front.data.length - 1]);
    const regret = report.charts.regret;
    if (!regret) return;
    const last = regret.data.length - 1;
    const found = regret.data.slice(0, last).flatMap((trace) =>
      trace.customdata.map((id, i) => [id, trace.x[i], trace.y[i]]));
    const one = found.find(([id]) => id[0] === selected.run && id[1] === selected.point);
    Plotly.restyle("regret", one ? { x: [[one[1]]], y: [[one[2]]] } : { x: [[]], y: [[]] }, [last]);
  }

  function showFilm() {
    const run = runs[selected.run];
    const has = run.films.length > 0;
    at("film-figure").hidden = !has;
    at("no-film").hidden = has;
    at("no-film").textContent = has ? "" : `No films: ${run.no_films}`;
    document.querySelectorAll(".film-only").forEach((cell) => { cell.hidden = !has; });
    const film = has ? run.films[nearest(run, selected.point, stops(run))] : null;
    const shown = film && describe(run, film.point);
    player.show(film, (film && film.point !== selected.point ? "The nearest filmed preference: " : "") + shown, shown);
  }

  // A row for each objective: what the film returns, and the mean of the evaluation.
  function showReturns() {
    const run = runs[selected.run];
    at("returns").replaceChildren(...objectives.map((name, i) => {
      const row = returnRow(name, i, player.film, run.films, run.colour);
      const spread = run.spread === null ? "" : ` ± ${number(run.spread[selected.point][i])}`;
      row.append(element("td", number(run.values[selected.point][i]) + spread));
      return row;
    }));
    const parts = [run.episodes];
    if (run.regrets !== null) parts.push(`preference regret ${number(run.regrets[selected.point])}`);
    parts.push(run.on_front[selected.point] ? "on the front" : "dominated by another point");
    at("about-point").textContent = `${parts.join("; ")}.`;
    player.tick();
  }

  function showSlider() {
    const run = runs[selected.run];
    const slider = at("preference");
    slider.max = stops(run).length - 1;
    slider.value = nearest(run, selected.point, stops(run));
    slider.setAttribute("aria-valuetext", describe(run, selected.point));
    at("preference-text").textContent = weights(run, selected.point);
    at("preference-field").hidden = stops(run).length < 2;
    const named = objectives.length === 2 && run.preferences !== null;
    at("end-low").textContent = named ? `← ${objectives[1]}` : "";
    at("end-high").textContent = named ? `${objectives[0]} →` : "";
  }

  function markRow() {
    for (const row of at("points").tBodies[0].rows) {
      row.toggleAttribute("aria-current", Number(row.dataset.point) === selected.point);
    }
  }

  function showTable() {
    const run = runs[selected.run];
    const head = element("tr");
    for (const title of ["Preference", ...objectives, ...(run.regrets === null ? [] : ["Regret"]), ""]) {
      head.append(element("th", title, { scope: "col" }));
    }
    at("points").tHead.replaceChildren(head);
    const rows = run.values.map((values, point) => {
      const row = element("tr", undefined, { "data-point": point });
      row.append(element("th", weights(run, point), { scope: "row" }));
      for (const value of values) row.append(element("td", number(value)));
      if (run.regrets !== null) row.append(element("td", number(run.regrets[point])));
      const button = element("button", "Show", { type: "button", "aria-label": `Show ${describe(run, point)}` });
      button.addEventListener("click", () => {
        select(selected.run, point);
        at("choose").scrollIntoView({ behavior: stillness ? "auto" : "smooth" });
      });
      const cell = element("td");
      cell.append(button);
      row.append(cell);
      return row;
    });
    at("points").tBodies[0].replaceChildren(...rows);
  }

  function select(run, point) {
    const isOther = run !== selected.run;
    selected.run = run;
    selected.point = point;
    at("run").value = String(run);
    if (isOther) showTable();
    showSlider();
    showFilm();
    showReturns();
    mark();
    markRow();
  }

  function clickable(id) {
    at(id).on("plotly_click", (event) => {
      const clicked = event.points.find((one) => one.customdata);
      if (clicked) select(...clicked.customdata);
    });
  }

  function showGrowth() {
    const { states } = report;
    const slider = at("growth-step");
    at("growth-section").hidden = states.length < 2;
    slider.max = states.length - 1;
    slider.value = states.length - 1;
    const show = () => {
      const state = states[Number(slider.value)];
      const text = `${state.steps.toLocaleString("en")} steps`;
      at("growth-text").textContent = text;
      slider.setAttribute("aria-valuetext", text);
      Plotly.react("growth", state.data, { ...report.charts.growth.layout, uirevision: "kept" }, config);
    };
    let timer = null;
    const stop = () => {
      clearInterval(timer);
      timer = null;
      at("growth-play").textContent = "Play";
      at("growth-play").setAttribute("aria-pressed", "false");
    };
    slider.addEventListener("input", () => { stop(); show(); });
    at("growth-play").addEventListener("click", () => {
      if (timer !== null) return stop();
      if (Number(slider.value) === states.length - 1) { slider.value = 0; show(); }
      at("growth-play").textContent = "Pause";
      at("growth-play").setAttribute("aria-pressed", "true");
      timer = setInterval(() => {
        slider.value = Number(slider.value) + 1;
        show();
        if (Number(slider.value) === states.length - 1) stop();
      }, 700);
    });
    if (states.length > 1) show();
  }

  const drawn = Object.entries(report.charts).filter(([name]) => name !== "growth").map(([name, chart]) =>
    Plotly.newPlot(name, chart.data, chart.layout, config));
  showGrowth();
  Promise.all(drawn).then(() => {
    clickable("front");
    if (report.charts.regret) clickable("regret");
    runs.forEach((run, i) => at("run").append(element("option", run.name, { value: i })));
    at("run-field").hidden = runs.length < 2;
    at("run").addEventListener("change", () => {
      const run = runs[Number(at("run").value)];
      select(Number(at("run").value), Math.min(selected.point, run.values.length - 1));
    });
    at("preference").addEventListener("input", () => {
      select(selected.run, stops(runs[selected.run])[Number(at("preference").value)]);
    });
    showTable();
    const first = stops(runs[0]);
    select(0, first[Math.floor(first.length / 2)]);
    document.body.dataset.ready = "true";
  });
})();
