"use strict";
// Without this script all rows are shown.
const filters = [...document.querySelectorAll(".filters select")];
const rows = [...document.querySelectorAll("table.filtered tbody tr")];
const results = [...document.querySelectorAll("details[data-policy]")]; // of a leaderboard
const entries = [...document.querySelectorAll("details.entry")];

const getText = (row, column) => row.cells[column].firstChild?.textContent ?? "";
const findColumn = (name) => filters.find(({ dataset }) => dataset.name === name)?.dataset.column;

function show() {
  const shown = rows.filter((row) => {
    row.hidden = filters.some(({ value, dataset }) => value && getText(row, dataset.column) !== value);
    return !row.hidden;
  });
  document.querySelector("#count").textContent = shown.length;
  document.querySelector("#empty").hidden = shown.length > 0;
  if (!results.length) return;
  const [policy, protocol] = [findColumn("policy"), findColumn("protocol")];
  const names = new Set(shown.map((row) => `${getText(row, policy)}\n${getText(row, protocol)}`));
  for (const result of results) result.hidden = !names.has(`${result.dataset.policy}\n${result.dataset.protocol}`);
  for (const entry of entries) entry.hidden = [...entry.querySelectorAll("details")].every(({ hidden }) => hidden);
}

for (const filter of filters) filter.addEventListener("input", show);
if (filters.length) show(); // a browser may keep what was chosen before a reload
