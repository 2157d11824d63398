// In a search, "-word" means "without word". Here a user who types "--with" or "-55" searches for the word itself.
document.addEventListener("input", ({target}) => {
  if (target.matches(".md-search__input")) target.value = target.value.replace(/(^|\s)-+(?=[^\s-])/g, "$1");
}, true);
