"""What a fix needs: records, geometry, map file, matching, localization, track, flight folders."""
