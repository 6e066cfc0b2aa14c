(() => {
  const page = JSON.parse(document.getElementById("data").textContent);
  const { Player, at, config, coordinates, element, number, returnRow } = explorer;
  const { objectives } = page;
  const two = objectives.length === 2;
  const SETTLED = 350; // ms without a move, after which the policy is rolled out
  const STEPS = 100; // of a slider
  const PREDICTED = page.front.data.length - 2;
  const ROLLOUT = page.front.data.length - 1;
  const player = new Player(page.fps);
  let preference = page.start;
  let wish = 0;
  let settling = null;
  let asking = false;
  const said = { predicted: "", rollout: "" };

  // Two decimals, as the sliders have them, or as many as a weight between needs.
  const decimals = (w) => (w.every((x) => Math.abs(100 * x - Math.round(100 * x)) < 1e-3) ? 2 : 3);
  const written = (w) => w.map((x) => x.toFixed(decimals(w))).join(" / ");
  const rounded = (x, digits) => number(Number(x.toPrecision(digits)));
  const described = (w) => w.map((x, i) => `${x.toFixed(decimals(w))} ${objectives[i]}`).join(", ");

  async function ask(action, question) {
    const request = { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(question) };
    let answer;
    try {
      answer = await fetch(action, request);
    } catch {
      throw new Error("The server does not answer: was it ended?");
    }
    const content = await answer.json();
    if (!answer.ok) throw new Error(content.error);
    if (content.superseded) throw new Error("Another page asked for something newer meanwhile: ask again.");
    return content;
  }

  function complain(error) {
    at("trouble").textContent = error.message;
    at("trouble").hidden = false;
  }

  // ------------------------------------------------------------------------------------------------ preference

  // One objective's weight is set, the others keep their proportions.
  function withWeight(i, weight) {
    const rest = preference.reduce((sum, x, k) => sum + (k === i ? 0 : x), 0);
    const share = (x) => (rest > 1e-9 ? x / rest : 1 / (objectives.length - 1));
    return preference.map((x, k) => (k === i ? weight : (1 - weight) * share(x)));
  }

  function makeSliders() {
    const made = (two ? [objectives[0]] : objectives).map((name, i) => {
      const box = element("div", undefined, { class: two ? "field slider" : "field slider row" });
      const id = `weight-${i}`;
      const slider = element("input", undefined, { type: "range", id, min: 0, max: STEPS, step: 1 });
      slider.addEventListener("input", () => choose(withWeight(i, Number(slider.value) / STEPS)));
      box.append(element("label", two ? "Preference" : name, { for: id }));
      const output = element("output", undefined, { id: `weight-text-${i}`, for: id });
      if (two) {
        const ends = element("div", undefined, { class: "ends", "aria-hidden": "true" });
        ends.append(element("span", `← ${objectives[1]}`), element("span", `${objectives[0]} →`));
        box.append(" ", output, slider, ends);
      } else {
        box.append(slider, output);
      }
      return box;
    });
    at("sliders").replaceChildren(...made);
  }

  function showSliders() {
    (two ? [0] : objectives).forEach((_, i) => {
      at(`weight-${i}`).value = Math.round(STEPS * preference[i]);
      at(`weight-${i}`).setAttribute("aria-valuetext", two ? described(preference) : preference[i].toFixed(2));
      at(`weight-text-${i}`).textContent = two ? written(preference) : preference[i].toFixed(2);
    });
  }

  // The page is "moved", then "rolling" and "filming", or searches a "bound", and at last it is "still". What begins cancels
  // what was under way: whoever waited for an answer asks `current()` before it shows that, and before it asks for more.
  function begin(state) {
    clearTimeout(settling);
    wish += 1;
    const mine = wish;
    enter(state);
    return () => mine === wish;
  }

  function enter(state) {
    document.body.dataset.state = state;
    at("status").textContent = { rolling: "Rolling out …", filming: "Filming …" }[state] || "";
  }

  function choose(w) {
    preference = w;
    begin("moved");
    at("trouble").hidden = true;
    showSliders();
    waiting();
    predict();
    settling = setTimeout(settle, SETTLED);
  }

  // One question at a time; what was moved meanwhile is asked next.
  async function predict() {
    if (asking) return;
    asking = true;
    const asked = preference;
    try {
      showPrediction(await ask("/predict", { preference }));
    } catch (error) {
      complain(error);
    }
    asking = false;
    document.body.dataset.ready = "true";
    if (asked !== preference) predict();
  }

  async function settle() {
    const current = begin("rolling");
    const steps = [["rolling", "/around", showAround], ["rolling", "/rollout", showRollout]];
    if (!page.noFilm) steps.push(["filming", "/film", showFilm]);
    try {
      for (const [state, action, show] of steps) {
        enter(state);
        const answer = await ask(action, { preference });
        if (!current()) return;
        show(answer);
      }
    } catch (error) {
      if (!current()) return;
      complain(error);
    }
    enter("still");
  }

  // --------------------------------------------------------------------------------------------------- answers

  function makeRows() {
    at("returns").replaceChildren(...objectives.map((name, i) => {
      const row = element("tr");
      row.append(element("th", name, { scope: "row" }));
      row.append(element("td", "", { class: "predicted", id: `predicted-${i}` }));
      row.append(element("td", "", { class: "waiting", id: `rollout-${i}` }));
      return row;
    }));
  }

  function fillCell(id, value, error) {
    at(id).replaceChildren(number(value));
    if (error !== null) at(id).append(" ", element("span", `± ${rounded(error, 2)}`, { class: "error" }));
  }

  function mark(trace, values) {
    Plotly.restyle("front", coordinates(values, page.ranges), [trace]);
  }

  function waiting() {
    objectives.forEach((_, i) => at(`rollout-${i}`).classList.add("waiting"));
    at("alternatives").classList.add("stale");
    at("film-returns").classList.add("stale");
  }

  function showPrediction(answer) {
    answer.returns.forEach((value, i) => fillCell(`predicted-${i}`, value, answer.error[i]));
    mark(PREDICTED, answer.returns);
    const error = answer.error.includes(null) ? "" : "; ± is the error nearby";
    said.predicted = `Predicted in ${rounded(1000 * answer.seconds, 2)} ms${error}.`;
    say();
  }

  function say() {
    at("answered").textContent = `${said.predicted} ${said.rollout}`;
  }

  function showRollout(answer) {
    const n = answer.n_episodes;
    said.rollout = n === 1 ? "The rollout is one episode: nothing here is random." : `The rollout: mean ± standard deviation of ${n} episodes.`;
    say();
    answer.discounted.forEach((value, i) => {
      fillCell(`rollout-${i}`, value, answer.discounted_spread && answer.discounted_spread[i]);
      at(`rollout-${i}`).classList.remove("waiting");
    });
    const cell = (id) => at(id).textContent;
    at("spoken").textContent = objectives.map((name, i) => `${name}: predicted ${cell(`predicted-${i}`)}, rollout ${cell(`rollout-${i}`)}`).join("; ");
    mark(ROLLOUT, answer.discounted);
    const made = answer.alternatives.map((one) => {
      const item = element("li");
      const text = element("span");
      text.append(element("strong", written(one.preference)), ` returns ${one.returns.map(number).join(" / ")}; difference `,
        `${rounded(one.distance, 2)}, most in the ${one.differs}`);
      const button = element("button", "Show", { type: "button", "aria-label": `Show ${described(one.preference)}` });
      button.addEventListener("click", () => {
        choose(one.preference);
        at("choose").scrollIntoView();
        at("weight-0").focus({ preventScroll: true }); // This button goes away with the next rollout.
      });
      item.append(text, button);
      return item;
    });
    const none = element("li", "None of the policies that were rolled out returns alike and moves differently.");
    at("alternatives").replaceChildren(...(made.length > 0 ? made : [none]));
    at("alternatives").classList.remove("stale");
  }

  function showFilm(next) {
    if (player.film !== null) URL.revokeObjectURL(player.film.url);
    const shown = described(next.preference);
    player.show(next, shown, shown);
    at("film-returns").replaceChildren(...objectives.map((name, i) => returnRow(name, i, next, [next], "#0072b2")));
    at("film-table").hidden = false;
    at("film-returns").classList.remove("stale");
    player.tick();
  }

  function showAround(answer) {
    at("rates").replaceChildren(two ? rateSentences(answer.rates) : rateTable(answer.rates));
    at("seeds").textContent = "";
    if (answer.seeds.length === 0) return;
    const texts = objectives.map((name, i) => {
      const ends = [Math.min, Math.max].map((end) => number(end(...answer.seeds.map((one) => one[i]))));
      return `${name} ${[...new Set(ends)].join(" to ")}`;
    });
    const n = answer.seeds.length;
    at("seeds").textContent = `The same preference after ${n === 1 ? "one training" : `${n} trainings`} with another seed: ${texts.join(", ")}.`;
  }

  function rateSentences(rates) {
    const list = element("ul", undefined, { class: "plain" });
    for (const [given, gained] of [[0, 1], [1, 0]]) {
      const rate = rates[given][gained][gained];
      const item = element("li");
      const text = element("span", undefined, { class: "rate" });
      if (rate === null) text.append(`Less in ${objectives[given]} buys nothing in ${objectives[gained]} here.`);
      else text.append(`1 less in ${objectives[given]} buys `, element("strong", rounded(rate, 3)), ` in ${objectives[gained]}.`);
      item.append(text);
      list.append(item);
    }
    return list;
  }

  // A row for each shift of weight that takes from one objective and gives to the other, with what it does to all of them.
  function rateTable(rates) {
    const pairs = objectives.flatMap((_, i) => objectives.map((_, k) => [i, k])).filter(([i, k]) => rates[i][k][k] !== null);
    if (pairs.length === 0) return element("p", "No small shift of weight takes from one objective and gives to another here.");
    const box = element("div", undefined, { class: "scroll", tabindex: "0", role: "region", "aria-label": "Exchange rates" });
    const table = element("table", undefined, { class: "small rate" });
    const head = element("tr");
    head.append(...["What it changes", ...objectives].map((name) => element("th", name, { scope: "col" })));
    table.append(element("thead"), element("tbody"));
    table.tHead.append(head);
    for (const [i, k] of pairs) {
      const row = element("tr");
      row.append(element("th", `1 less in ${objectives[i]}, weight to ${objectives[k]}`, { scope: "row" }));
      for (const change of rates[i][k]) row.append(element("td", (change > 0 ? "+" : "") + rounded(change, 3)));
      table.tBodies[0].append(row);
    }
    box.append(table);
    return box;
  }

  // ----------------------------------------------------------------------------------------------------- wishes

  // While it works, its button says so; what it finds is shown below it.
  async function working(button, answerBox, work) {
    const before = button.textContent;
    button.disabled = true;
    button.textContent = "Working …";
    answerBox.replaceChildren();
    try {
      answerBox.replaceChildren(...(await work()));
    } catch (error) {
      answerBox.replaceChildren(element("p", error.message, { class: "bad" }));
    }
    button.disabled = false;
    button.textContent = before;
    if (document.activeElement === document.body) button.focus({ preventScroll: true });
  }

  async function findBound() {
    const before = preference;
    const objective = Number(at("bound-objective").value);
    const value = Number(at("bound-value").value);
    if (at("bound-kind").value === "less" && value < 0) throw new Error("How much less it may be is 0 or more.");
    const current = begin("bound");
    const bound = { preference, objective, [at("bound-kind").value]: value };
    const found = await ask("/bound", bound).catch((error) => ({ error }));
    if (!current()) throw new Error("The preference was moved meanwhile: ask again.");
    if (found.error) {
      settle(); // as this search cancelled it
      throw found.error;
    }
    choose(found.preference);
    const name = objectives[objective];
    const spread = (i) => (found.discounted_spread ? ` ± ${rounded(found.discounted_spread[i], 2)}` : "");
    const returns = objectives.map((one, i) => `${one} ${number(found.discounted[i])}${spread(i)}`).join(", ");
    const of = found.n_episodes === 1 ? "its episode" : `the mean of ${found.n_episodes} episodes`;
    const text = found.met
      ? `${written(found.preference)} kept it in ${of}: ${returns}, where at least ${number(found.at_least)} ${name} was asked for.`
      : `No policy that was found has ${number(found.at_least)} ${name}. The closest is ${written(found.preference)}: ${returns} in ${of}.`;
    const back = element("button", `Back to ${written(before)}`, { type: "button" });
    back.addEventListener("click", () => choose(before));
    return [element("p", text, { class: found.met ? "good" : "bad" }), back];
  }

  async function keepThisOne() {
    const mine = preference;
    const kept = await ask("/keep", { preference: mine });
    const said = element("p", `Kept ${written(mine)} in `, { class: "good" });
    said.append(element("code", kept.folder), `: ${kept.files.join(", ")}.`);
    const code = `model = MOMBA.load("${kept.folder}/model.zip")\naction, _ = model.predict(obs, deterministic=True)`;
    return [said, ...kept.notes.map((note) => element("p", note, { class: "notice" })), element("pre", code)];
  }

  function useForms() {
    objectives.forEach((name, i) => at("bound-objective").append(element("option", name, { value: i })));
    at("bound").addEventListener("submit", (event) => {
      event.preventDefault();
      working(at("bound").querySelector("button"), at("bound-answer"), findBound);
    });
    at("keep").addEventListener("click", () => working(at("keep"), at("kept"), keepThisOne));
    at("no-film").textContent = `No film: ${page.noFilm}`;
    at("no-film").hidden = !page.noFilm;
    at("film").hidden = Boolean(page.noFilm);
  }

  makeSliders();
  makeRows();
  useForms();
  Plotly.newPlot("front", page.front.data, page.front.layout, config).then(() => {
    at("front").on("plotly_click", (event) => {
      const clicked = event.points.find((one) => one.customdata);
      if (clicked) choose(page.preferences[clicked.customdata[1]]);
    });
    choose(page.start);
  });
})();
