"""The demo: `flights` flies and reads nine recorded flights, `picture` draws them."""
