"use strict";
// A model that is chosen in one place is marked in every table and picture; without scripts the page shows all of them.
addEventListener("DOMContentLoaded", () => {
  const box = document.getElementById("entrant");
  const all = document.querySelectorAll("[data-entrant]");
  const mark = name => { for (const one of all) one.classList.toggle("chosen", one.dataset.entrant === name); };
  box.closest("label").hidden = false;
  box.addEventListener("change", () => mark(box.value));
  for (const one of all) one.addEventListener("click", () => { box.value = one.dataset.entrant; mark(box.value); });
});
