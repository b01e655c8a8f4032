"""Design studies: figures 5 to 8 of Cao & Conn 2018 and beyond, from TOML to pictures, tables and CSV."""
