/* A page of figures and tables, which stand in it already. */
document.querySelector("header .options").append(themeButton(), " ", printButton());
document.querySelectorAll(".scroll").forEach(watchScroll);
