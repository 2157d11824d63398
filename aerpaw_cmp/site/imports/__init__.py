"""Maps of others: buildings, woods and heights from OSM, GeoJSON, KML."""
