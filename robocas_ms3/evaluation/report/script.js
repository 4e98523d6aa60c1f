"use strict";
// Without this script all rows are shown.
const filters = [...document.querySelectorAll(".filters select")];
const rows = [...document.querySelectorAll("table.filtered tbody tr")];
const entries = [...document.querySelectorAll("details[data-policy]")];

function show() {
  let count = 0;
  for (const row of rows) {
    row.hidden = filters.some(
      ({ value, dataset }) => value && row.cells[dataset.column].firstChild?.textContent !== value
    );
    count += !row.hidden;
  }
  document.querySelector("#count").textContent = count;
  const empty = document.querySelector("#empty");
  if (empty) empty.hidden = count > 0;
  for (const entry of entries) {
    entry.hidden = filters.some(({ value, dataset }) => value && (entry.dataset[dataset.name] ?? value) !== value);
  }
}

for (const filter of filters) filter.addEventListener("input", show);
if (filters.length) show(); // a browser may keep what was chosen before a reload
